"""Workers on machines that are lost: no frame is blamed, and states go from machine to machine and back."""

from __future__ import annotations

import errno
from contextlib import contextmanager

import fakes
import httpx
import pytest
from running import Running, fake_settings, pictures
from sending import create, put_framed, status, wait_for
from waiting import HANG_S

from scas4d_core.storage.history import History
from server.processes import worker
from server.processes.placement import Placement, ProcessExit
from server.storage.fencing import current_epoch
from server.storage.layout import DataFolder
from server.updates import worker_process
from server.updates.worker_process import MAX_WAIT_AFTER_LOSS_S, OTHER_DEATHS, WorkerDeaths


class Machines(Placement):
    """Runs all on this machine; whatever ends a worker is told as if its machine had gone with it."""

    fenced = True

    def start(self, entry, spec, on_message, on_end):
        def lost(why):
            on_end(ProcessExit(None, "the worker's node was lost", lost=True) if entry is worker.main else why)

        return super().start(entry, spec, on_message, lost)


@contextmanager
def service(folder, placement):
    running = Running(fake_settings(folder, queue_frames=20), placement=placement)
    try:
        with httpx.Client(base_url=running.url, timeout=HANG_S) as http:
            yield http
    finally:
        running.stop()


def states(folder, id):
    return DataFolder(folder).scene(id).states


def sent(http, id, frames):
    for index in frames:
        assert put_framed(http, id, index, pictures(index)).status_code == 202


def committed(http, id, count):
    wait_for(lambda: status(http, id)["committed"] == count)


def test_no_frame_is_set_aside_for_machines_that_were_lost(tmp_path):
    with service(tmp_path, Machines) as http:
        id = create(http)
        sent(http, id, [0])
        committed(http, id, 1)
        assert put_framed(http, id, 1, pictures(fakes.DIES)).status_code == 202
        wait_for(lambda: status(http, id)["worker_deaths"] > OTHER_DEATHS)
        assert http.get(f"/v1/scenes/{id}/frames/1").json()["state"] in ("queued", "updating")


@pytest.mark.parametrize(
    "fault",
    [OSError(errno.EIO, "Input/output error"), OSError(errno.ENOSPC, "No space left"), KeyError("a fault of its own")],
)
def test_states_that_cannot_be_taken_over_are_tried_again(tmp_path, monkeypatch, fault):
    begin, faults = worker_process.begin_epoch, []

    def faulty(states, lock):
        if len(faults) < 2:
            faults.append(fault)
            raise fault
        return begin(states, lock)

    monkeypatch.setattr(worker_process, "begin_epoch", faulty)
    with service(tmp_path, Machines) as http:
        id = create(http)
        wait_for(lambda: "cannot take over the committed states: " in (status(http, id)["error"] or ""))
        sent(http, id, [0])
        committed(http, id, 1)
        assert len(faults) == 2
        assert status(http, id)["error"] is None


def test_states_go_to_other_machines_and_back(tmp_path):
    """A worker that was left on another machine is fenced from the local ones after it, too."""
    with service(tmp_path, Placement) as http:
        id = create(http)
        sent(http, id, range(2))
        committed(http, id, 2)
        assert current_epoch(states(tmp_path, id)) is None
    with service(tmp_path, Machines) as http:
        sent(http, id, [2])
        committed(http, id, 3)
    there = current_epoch(states(tmp_path, id))
    assert there == 1
    left = History.open(states(tmp_path, id).resolve())
    with service(tmp_path, Placement) as http:
        sent(http, id, [3])
        committed(http, id, 4)
        left.append(4, 9.0, left.gaussians(0), {})
        sent(http, id, [4])
        committed(http, id, 5)
        assert http.get(f"/v1/scenes/{id}/frames/4").json()["time"] == pytest.approx(0.4)
    assert current_epoch(states(tmp_path, id)) > there
    assert History.load(states(tmp_path, id)).indices == [0, 1, 2, 3, 4]


def test_machines_that_are_lost_one_after_another_are_given_more_and_more_time():
    """A frame may be what takes them down."""
    deaths = WorkerDeaths()
    pauses = [deaths.note_death(ProcessExit(None, lost=True))[1] for _ in range(12)]
    assert pauses[:4] == [0.5, 0.5, 0.5, 1.0]
    assert pauses[-1] == MAX_WAIT_AFTER_LOSS_S
    deaths.note_commit()
    assert deaths.note_death(ProcessExit(None, lost=True)) == (False, 0.5)
