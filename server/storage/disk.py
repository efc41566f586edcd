"""Full disks, and locks of folders."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shutil
from pathlib import Path

from scas4d_core.errors import message_of
from server.problems import Problem
from server.storage.layout import DataFolder, SceneFolder

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of a full disk: they go away once there is room."""


def no_room(error: BaseException | None) -> bool:
    """True for an error of a full disk, and for one raised while such an error was handled (as zipfile does)."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            return True
        error = error.__cause__ or error.__context__
    return False


def full_disk(error: Exception) -> Problem:
    """Makes the answer, 507, for a full disk."""
    return Problem(
        507,
        f"the disk has no room: {message_of(error)}",
        remedy="free room in the service's data folder, or shorten the scene's retention, and send the same again",
        headers={"Retry-After": "5"},
    )


def free_bytes(path: Path) -> int:
    """Returns the bytes that are free where a folder lies."""
    return shutil.disk_usage(path).free


class FolderLock:
    """Lock of a folder, held by one process at a time; the kernel releases it when the process ends.

    Args:
        path: of the lock's file; made when missing.
        wait: until it is free; otherwise BlockingIOError where another process holds it.
    """

    def __init__(self, path: Path, *, wait: bool) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BaseException:
            os.close(self._file)
            raise

    def write(self, text: str) -> None:
        """Writes a note for people into the file, such as the holder's process id."""
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, text.encode(), 0)

    def release(self) -> None:
        """Releases the lock."""
        os.close(self._file)


def lock_data(data: Path) -> FolderLock:
    """Locks the data folder for this service; the folder is made when missing.

    Raises:
        RuntimeError: another service is at work in it.
    """
    data.mkdir(parents=True, exist_ok=True)
    try:
        return FolderLock(DataFolder(data).lock, wait=False)
    except BlockingIOError:
        raise RuntimeError(
            f"another service is at work in {data}; stop it, or give this one another folder: --data FOLDER"
        ) from None


def alone(folder: SceneFolder) -> FolderLock | None:
    """Sees to it that no other worker commits to a scene: waits for its end.

    With an epoch there is nothing to wait for and no lock: one on another machine may stop while it holds one, and
    commits to a folder of its own (`server.storage.fencing`).
    """
    path = folder.worker_lock
    if folder.epoch is not None:
        beside = path.with_name(f"{path.name}.{folder.epoch}")
        with contextlib.suppress(OSError):
            beside.write_text(f"{os.getpid()}\n")
            beside.replace(path)
        return None
    # A service that was killed leaves a worker in the middle of an update: two must not commit to one history.
    lock = FolderLock(path, wait=True)
    with contextlib.suppress(OSError):  # a full disk is no reason not to work
        lock.write(f"{os.getpid()}\n")
    return lock
