"""A worker that waits for room on the disk: what it is told meanwhile, and when it ends."""

from __future__ import annotations

from multiprocessing import Pipe

import pytest
from running import make_rig

from scas4d_core.presets import preset
from server.messages import RepairFiles, SceneSpec, Stop
from server.processes.worker import Worker, _Stopped
from server.storage.layout import SceneFolder


@pytest.fixture
def worker(tmp_path):
    ours, theirs = Pipe()
    worker = Worker(SceneSpec(SceneFolder(tmp_path), make_rig(), preset("scas4d")), theirs)
    worker.service = ours
    yield worker
    ours.close()
    theirs.close()


def test_other_messages_are_kept_for_later(worker):
    worker.service.send(RepairFiles(("frame_000001.npz",)))
    worker.service.send(RepairFiles(("frame_000002.npz",)))
    worker._await_room(0.05)
    worker.service.send(RepairFiles(("frame_000003.npz",)))
    assert [worker.next().names[0][-5] for _ in range(3)] == ["1", "2", "3"]


def test_stop_ends_it_at_once(worker):
    worker.service.send(RepairFiles(("frame_000001.npz",)))
    worker.service.send(Stop())
    with pytest.raises(_Stopped):
        worker._await_room(60)
