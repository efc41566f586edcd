"""A journal that is written anew says the same: replaying it gives an equal ledger."""

from __future__ import annotations

import asyncio
import errno
import os
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from waiting import HANG_S

from client.wire import Budget, FileKind, FrameState, ReconstructionRequest
from server.storage.events import (
    BudgetChanged,
    CameraAccepted,
    FrameAccepted,
    FrameFailed,
    FrameMissing,
    FramesSkipped,
    PauseChanged,
    PicturesDeleted,
    ReconstructionBegun,
    SceneCreated,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.journal import Journal, replay
from server.storage.ledger import Ledger
from server.storage.snapshot import events_of
from tests.helpers.journals import read_journal

MADE = SceneCreated(definition={"id": "abc"})


def identity(index):
    return f"{index:064x}"


def state_of(ledger):
    frames = []
    for index in range(len(ledger.frames)):
        entry = ledger.frames[index]
        note = entry.rare_properties
        parts = None if note.parts is None else (note.parts.time, note.parts.hashes, note.parts.files)
        frames.append(
            (entry.state, entry.time, entry.identity, entry.files, entry.deleted, entry.error, note.dropped,
             note.own_deaths, note.other_deaths, parts)
        )  # fmt: skip
    opened = {index: (frame.time, frame.hashes, frame.files) for index, frame in ledger.open.items()}
    rest = (ledger.paused, ledger.fatal, ledger.states_deleted, ledger.budgets, dict(ledger.counts), ledger.begun)
    return frames, opened, *rest


def fold(events):
    ledger = Ledger("abc")
    for event in events:
        ledger.apply(event)
    return ledger


@st.composite
def lives(draw):
    """Facts in an order that a scene may write them in, and the states that it has committed."""
    events, committed, held = [], [], []
    for index in range(draw(st.integers(0, 8))):
        how = draw(st.sampled_from(["whole", "parts", "missing", "lost", "found"]))
        if how == "missing":
            events.append(FrameMissing(index=index, reason=draw(st.sampled_from(["cable", ""]))))
            continue
        if how == "lost":
            continue
        if how == "found":
            events.append(StateFound(index=index, time=draw(st.sampled_from([None, index / 10]))))
            committed.append(index)
            continue
        files = (f"{index:010d}-{0:012x}.frame",)
        if how == "parts":
            events += parts(index, draw(st.integers(1, 3)))
            files = tuple(event.file for event in events if isinstance(event, CameraAccepted) and event.index == index)
        events.append(FrameAccepted(index=index, time=index / 10, identity=identity(index), files=files))
        for own in draw(st.lists(st.booleans(), max_size=2)):
            events.append(WorkerDied(index=index, reason="x", own=own))
        end = draw(st.sampled_from(["committed", "set aside", "skipped", "waits"]))
        if end == "set aside":
            events.append(FrameFailed(index=index, reason=f"fault {index}", dropped={"c0": "dark"}))
        elif end == "skipped":
            events.append(FramesSkipped(frames=(index,), by=index + 1))
        elif end == "committed":
            committed.append(index)
        if end != "waits" and draw(st.booleans()):
            held.append(index)
    if held:
        events.append(PicturesDeleted(frames=tuple(held)))
    if gone := [index for index in committed if draw(st.booleans())]:
        events.append(StatesDeleted(frames=tuple(gone), reason=draw(st.sampled_from([None, "damaged"]))))
    if draw(st.booleans()):
        begun = draw(st.integers(0, 9))
        events.insert(draw(st.integers(0, len(events))), begins(1, begun))
        committed = [index for index in committed if index >= begun]
    if draw(st.booleans()):
        events.append(PauseChanged(paused=True))
    for index in draw(st.lists(st.integers(0, 9), max_size=2, unique=True)):
        events.append(BudgetChanged(index=index, budget=Budget(iterations=10 + index)))
    if draw(st.booleans()):
        events += parts(20, draw(st.integers(1, 3)))
    return events, committed


def begins(number, index):
    return ReconstructionBegun(
        number=number, index=index, points=None, settings={}, request=ReconstructionRequest(frame=index)
    )


def parts(index, count):
    return [
        CameraAccepted(
            index=index, time=index / 10, camera=f"c{k}", file=f"{index:010d}-{k:012x}.frame",
            hashes={FileKind.IMAGE: identity(k)},
        )
        for k in range(count)
    ]  # fmt: skip


@settings(max_examples=300, deadline=None)
@given(lives())
def test_the_events_of_a_ledger_give_an_equal_one(life):
    events, _ = life
    ledger = fold(events)
    again = fold(events_of(ledger.copy()))
    count = len(again.frames)
    assert count == len(ledger.frames)
    found, expected = state_of(again), state_of(ledger)
    assert found == expected


@settings(max_examples=200, deadline=None)
@given(lives())
def test_and_the_states_on_disk_bring_both_to_the_same(life):
    events, committed = life
    ledger = fold(events)
    kept = [index for index in committed if not ledger.frames[index].deleted]
    ledger.reconcile(kept, {})
    again = fold(events_of(ledger.copy()))
    again.reconcile(kept, {})
    assert state_of(again)[0] == state_of(ledger)[0]
    assert list(again.committed) == list(ledger.committed)


def test_a_fatal_frame_stays_fatal():
    ledger = fold(
        [
            FrameAccepted(index=0, time=0.0, identity=identity(0), files=("a",)),
            FrameFailed(index=0, reason="x", fatal=True),
        ]
    )
    assert fold(events_of(ledger)).fatal == "x"
    ledger.fatal = "the service failed: only in memory"
    assert fold(events_of(ledger)).fatal == "x"


def test_a_fault_of_the_service_is_not_journalled():
    ledger = fold([FrameAccepted(index=0, time=0.0, identity=identity(0), files=("a",))])
    ledger.fatal = "the service failed: only in memory"
    assert fold(events_of(ledger)).fatal is None


def journalled(path, lose):
    """Facts before and after something befell the file, as a scene appends them; what the journal says in the end."""
    ledger, said = Ledger("abc"), []

    def snapshot():
        return iter([MADE, *events_of(ledger.copy())])

    async def live():
        journal = Journal(path, 0, snapshot, said.append)
        await journal.append(MADE)
        for index in range(6):
            event = FrameAccepted(index=index, time=index / 10, identity=identity(index), files=(f"{index}",))
            await journal.append(event)
            ledger.apply(event)
            death = WorkerDied(index=index, reason="x", own=False)
            ledger.apply(death)
            await journal.append(death)
            if index == 3:
                lose(path, journal)
        await journal.close()

    asyncio.run(live())
    return ledger, said


def flip(path, journal):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 8
    path.write_bytes(content)
    journal.rewrite("journal.log is damaged (a flipped bit)")


def test_a_journal_that_is_deleted_replaced_or_damaged_is_written_anew(tmp_path):
    losses = {
        "deleted": lambda path, journal: path.unlink(),
        "replaced": lambda path, journal: os.replace(_other(path), path),
        "cut": lambda path, journal: os.truncate(path, 50),
        "flipped": flip,
    }
    for name, lose in losses.items():
        path = tmp_path / name / "journal.log"
        path.parent.mkdir()
        ledger, said = journalled(path, lose)
        assert len(said) == 1, name
        read = read_journal(path)
        assert read.damage == []
        assert read.events[0] == MADE
        assert state_of(fold(read.events)) == state_of(ledger), name
        assert ledger.counts[FrameState.QUEUED] == 6
        assert sorted(file.name for file in path.parent.iterdir()) == ["journal.log"]


def _other(path):
    other = path.with_suffix(".other")
    other.write_bytes(b"x" * 10_000)
    return other


def test_every_flipped_byte_of_a_journal_and_a_cut_beginning_are_damage(tmp_path):
    path = tmp_path / "journal.log"
    journalled(path, lambda path, journal: None)
    content = path.read_bytes()
    for at in range(len(content)):
        flipped = bytearray(content)
        flipped[at] ^= 1 << at % 8
        path.write_bytes(flipped)
        assert read_journal(path).damage, at
    second = content.index(b"S4DR", 4)
    assert replay(path, lambda event: None).begun
    for rest in (b"", content[second:]):
        path.write_bytes(rest)
        assert not replay(path, lambda event: None).begun
    path.unlink()
    assert not replay(path, lambda event: None).begun


def no_space(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_an_event_that_comes_while_a_renewal_fails_is_not_forgotten(tmp_path, monkeypatch):
    async def job():
        journal = Journal(tmp_path / "journal.log", 0, lambda: iter(()))
        began, go = asyncio.Event(), threading.Event()
        loop = asyncio.get_running_loop()

        def slow(*_):
            loop.call_soon_threadsafe(began.set)
            go.wait(HANG_S)
            no_space()

        monkeypatch.setattr(journal, "_replace", slow)
        journal.rewrite("it is damaged")
        await began.wait()
        appended = asyncio.create_task(journal.append(FrameMissing(index=0, reason="r")))
        await asyncio.sleep(0)
        go.set()
        # There is no room for a journal anew, and the file is in its place: the event goes behind what is there.
        await asyncio.wait_for(appended, HANG_S)
        await journal.close()

    asyncio.run(job())
    assert [event.index for event in read_journal(tmp_path / "journal.log").events] == [0]


def test_whoever_waits_for_a_renewal_that_breaks_is_told(tmp_path, monkeypatch):
    async def job():
        journal = Journal(tmp_path / "journal.log", 0, lambda: iter(()))

        def broken(*_):
            raise ValueError("an event that cannot be written")

        monkeypatch.setattr(journal, "_replace", broken)
        (tmp_path / "journal.log").unlink()
        with pytest.raises(ValueError, match="cannot be written"):
            await asyncio.wait_for(journal.append(FrameMissing(index=0, reason="r")), HANG_S)
        await journal.close()

    asyncio.run(job())
