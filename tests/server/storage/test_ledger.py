"""The ledger: folded from events, in little memory, and brought in line with the committed states."""

from __future__ import annotations

import tracemalloc
from dataclasses import fields

import pytest

from client.wire import CameraFitModel, CurvePointModel, FrameReportModel, FrameState
from scas4d_core.frame_report import CurvePoint, FrameReport
from scas4d_core.frame_times import FrameTime
from scas4d_core.update.result import CameraFit
from server.storage.events import (
    CameraAccepted,
    FrameAccepted,
    FrameFailed,
    FrameMissing,
    FramesSkipped,
    PicturesDeleted,
    StatesDeleted,
    WorkerDied,
)
from server.storage.frame_table import RECORD_LOST, RECORDS_KEPT, FrameTable
from server.storage.ledger import Ledger
from server.storage.report_fields import NOT_SENT, WIRE_NAMES

REPORT = {"iterations": 100, "psnr": 31.5, "gaussians": 2, "seconds": {"update": 0.5}, "dropped": {"c1": "dark"}}


def identity(index):
    return f"{index:064x}"


def taken(index, **more):
    return FrameAccepted(
        index=index, time=index / 10, identity=identity(index), files=(f"{index:010d}-{0:012x}.frame",), **more
    )


def ledger_of(*events):
    ledger = Ledger("abc")
    for event in events:
        ledger.apply(event)
    return ledger


def test_an_entry_says_what_the_events_said():
    events = [taken(0), FrameMissing(index=1, reason="cable"), taken(2), FramesSkipped(frames=(2,), by=3), taken(3)]
    events += [WorkerDied(index=3, reason="x", own=True), WorkerDied(index=3, reason="x", own=False)]
    events += [
        FrameFailed(index=3, reason="two deaths", dropped={"c0": "torn"}),
        taken(4),
        PicturesDeleted(frames=(0, 4)),
    ]
    ledger = ledger_of(*events)
    reports_ = [ledger.frames[index].report for index in range(5)]
    states = [FrameState.QUEUED, FrameState.MISSING, FrameState.SKIPPED, FrameState.FAILED, FrameState.QUEUED]
    assert [report.state for report in reports_] == states
    assert [report.time for report in reports_] == [0.0, None, 0.2, 0.3, 0.4]
    assert [report.identity for report in reports_] == [identity(0), None, identity(2), identity(3), identity(4)]
    assert [report.pictures_kept for report in reports_] == [False, False, True, True, False]
    assert [report.error for report in reports_[:2]] == [None, "cable"]
    assert "when frame 3 arrived" in reports_[2].error
    assert (reports_[3].error, reports_[3].worker_deaths) == ("two deaths", 2)
    assert reports_[3].dropped_cameras == {"c0": "torn"}
    assert ledger.frames[1].receipt is None
    assert ledger.frames[2].receipt.model_dump() == {
        "scene": "abc", "index": 2, "time": 0.2, "identity": identity(2), "warnings": [],
    }  # fmt: skip
    assert (ledger.frames[3].rare_properties.own_deaths, ledger.frames[3].rare_properties.other_deaths) == (1, 1)
    assert ledger.waiting() == [0, 4]
    assert ledger.frames.get(5) is None
    with pytest.raises(KeyError):
        ledger.frames[5]


def test_what_is_lost_before_an_event_is_set_aside():
    ledger = ledger_of(CameraAccepted(index=1, time=None, camera="c0", file="f", hashes={}), taken(2))
    assert ledger.next_frame == 3
    assert [ledger.frames[index].error for index in range(3)] == [RECORD_LOST, RECORD_LOST, None]
    assert ledger.open == {}
    ledger.apply(taken(1))  # found in the frame log
    assert (ledger.frames[1].state, ledger.frames[1].error) == (FrameState.QUEUED, None)
    assert ledger.counts[FrameState.FAILED] == 1


def test_states_that_are_there_commit_and_those_that_are_gone_are_told():
    ledger = ledger_of(*map(taken, range(6)), StatesDeleted(frames=(1,)), PicturesDeleted(frames=(0, 1, 2)))
    events = ledger.reconcile([0, 2, 4], {3: "torn"})
    assert list(ledger.committed) == [0, 2, 4]
    assert events == [StatesDeleted(frames=(3,), reason="torn")]
    assert (ledger.states_deleted, ledger.waiting()) == (2, [5])
    assert ledger.frames[3].deleted
    # The newest state turns out damaged: what comes after the one before is done again where its pictures are held.
    assert ledger.reconcile([0, 2], {4: "torn"}) == []
    assert (list(ledger.committed), ledger.waiting()) == ([0, 2], [3, 4, 5])
    gone = "its state is damaged, and its images are deleted"
    assert ledger.reconcile([0], {}) == [FrameFailed(index=1, reason=gone), FrameFailed(index=2, reason=gone)]
    assert ledger.frames[2].state == FrameState.FAILED


def test_a_state_whose_event_is_lost_is_committed():
    ledger = ledger_of(taken(0), taken(2))
    assert ledger.reconcile([0, 1, 2], {}) == []
    assert list(ledger.committed) == [0, 1, 2]
    assert ledger.frames[1].error is None
    ledger = ledger_of()
    assert ledger.reconcile([0, 3], {}) == []  # of the journal nothing is left
    assert (ledger.next_frame, list(ledger.committed)) == (4, [0, 3])


def test_many_states_deleted_at_once_are_those_deleted_one_by_one():
    one, many = (ledger_of(*map(taken, range(200))) for _ in range(2))
    for ledger in (one, many):
        ledger.reconcile(range(200), {})
    gone = tuple(range(1, 150))
    many.apply(StatesDeleted(frames=gone))
    for index in gone:
        one.apply(StatesDeleted(frames=(index,)))
    assert list(one.committed) == list(many.committed) == [0, *range(150, 200)]
    assert one.states_deleted == many.states_deleted == 149
    many.apply(StatesDeleted(frames=gone))
    assert many.states_deleted == 149


def test_the_numbers_of_the_newest_commits_are_in_memory():
    table = FrameTable("abc")
    table.grow(RECORDS_KEPT + 1)
    for index in range(RECORDS_KEPT + 1):
        table.enqueue(FrameTime(index, index / 10, index / 10), identity(index), (), None)
        table.set_state(index, FrameState.COMMITTED)
        table.set_record(index, REPORT)
    assert (table[0].record is None, table[1].record is None) == (True, False)
    report = table[RECORDS_KEPT].report
    assert (report.psnr, report.iterations, report.dropped_cameras) == (31.5, 100, {"c1": "dark"})
    assert report.seconds == {"update": 0.5, "total": 0.5}


def test_every_field_of_a_commit_reaches_the_wire_or_is_named_as_left_out():
    own = {"scene", "state", "error", "identity", "deleted", "received"}  # the service knows these itself
    noted = {
        "budget",
        "write_seconds",
        "publish_seconds",
        "threads",
        "recomputed",
        "resumed",
    }  # the worker adds them to the record
    committed = {field.name for field in fields(FrameReport)} | noted
    sent = {WIRE_NAMES.get(name, name) for name in committed - NOT_SENT}
    assert sent <= set(FrameReportModel.model_fields) - own
    assert committed >= NOT_SENT
    assert set(WIRE_NAMES) <= committed
    for core, wire in ((CameraFit, CameraFitModel), (CurvePoint, CurvePointModel)):
        assert set(core.__annotations__) == set(wire.model_fields)


@pytest.mark.slow
def test_a_day_of_frames_fits_in_memory():
    count, most = 50_000, 128  # bytes a frame, while their pictures and states are deleted behind them
    tracemalloc.start()
    ledger = ledger_of(taken(0))
    for index in range(1, count):
        ledger.apply(taken(index))
        ledger.set_state(index - 1, FrameState.COMMITTED)
        if index > 40:
            ledger.apply(PicturesDeleted(frames=(index - 40,)))
            ledger.apply(StatesDeleted(frames=(index - 40,)))
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert used < most * count
    assert len(ledger.committed) == 40
