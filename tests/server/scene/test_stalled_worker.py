"""A worker whose commit waits for room on the disk: what it does meanwhile, and when it ends."""

from __future__ import annotations

import errno
import threading
from multiprocessing import Pipe

import pytest
from running import make_rig
from waiting import HANG_S, wait_for

from scas4d_core.presets import preset
from server.messages import FrameCommitted, RepairFiles, SceneSpec, Stop, WaitingForDisk
from server.processes import commits
from server.processes.commits import CommitError, PendingCommit
from server.processes.worker import Worker, _Stopped
from server.storage.layout import SceneFolder


@pytest.fixture
def worker(tmp_path, monkeypatch):
    monkeypatch.setattr(commits, "STALL_S", 0.01)
    monkeypatch.setattr("server.processes.worker.STOP_S", 0.01)
    ours, theirs = Pipe()
    worker = Worker(SceneSpec(SceneFolder(tmp_path), make_rig(), preset("scas4d")), theirs)
    worker.service = ours
    worker.inbox.start()
    yield worker
    ours.close()
    theirs.close()


class Disk:
    """A disk that is full until `room` is set."""

    def __init__(self):
        self.room = threading.Event()
        self.written = []

    def write(self, name):
        if not self.room.is_set():
            raise OSError(errno.ENOSPC, "no room")
        self.written.append(name)


def pending(index, *writes, deletions=()):
    return PendingCommit(index, list(writes), FrameCommitted(index, {}), list(deletions))


def test_a_commit_is_reported_once_there_is_room_and_messages_arrive_meanwhile(worker):
    disk = Disk()
    worker._commits.put(pending(3, lambda: disk.write("checkpoint"), lambda: disk.write("frame")))
    assert isinstance(worker.service.recv(), WaitingForDisk)
    worker.service.send(RepairFiles(("frame_000001.npz",)))
    assert worker.next().names == ("frame_000001.npz",)
    disk.room.set()
    while isinstance(message := worker.service.recv(), WaitingForDisk):
        assert message.index == 3
    assert (message, disk.written) == (FrameCommitted(3, {}), ["checkpoint", "frame"])


def test_files_are_deleted_only_after_the_commit(worker):
    disk, deleted = Disk(), []
    worker._commits.put(pending(3, lambda: disk.write("frame"), deletions=[lambda: deleted.append(1)]))
    assert not worker._commits.wait(0.05)
    assert deleted == []
    disk.room.set()
    worker.service.send(RepairFiles(("frame_000001.npz",)))
    worker._await_commit()
    worker.next()
    assert deleted == [1]


def test_stop_ends_it_at_once(worker):
    disk = Disk()
    worker._commits.put(pending(3, lambda: disk.write("frame")))
    worker.service.send(Stop())
    wait_for(lambda: worker.inbox.wait_for_stop(0))
    with pytest.raises(_Stopped):
        worker._await_commit()
    disk.room.set()
    assert worker._commits.wait(HANG_S)


def test_a_commit_that_cannot_be_written_ends_the_worker(worker):
    def broken():
        raise OSError(errno.EIO, "broken disk")

    worker._commits.put(pending(3, broken))
    with pytest.raises(CommitError, match="frame 3 cannot be committed"):
        worker.next()
    with pytest.raises(CommitError):
        worker._await_commit()
