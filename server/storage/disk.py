"""Handling of full disks, and folder locks."""

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
"""Error numbers that indicate a full disk; these errors disappear once space is available."""


def no_room(error: BaseException | None) -> bool:
    """Returns whether an error, or any error in its chain of causes, indicates a full disk.

    For example, zipfile raises another error while handling the original one.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            return True
        error = error.__cause__ or error.__context__
    return False


def full_disk(error: Exception) -> Problem:
    """Returns the 507 response for a full disk."""
    return Problem(
        507,
        f"the disk is full: {message_of(error)}",
        remedy="free space in the service's data folder or shorten the scene's retention, then repeat the request",
        headers={"Retry-After": "5"},
    )


def free_bytes(path: Path) -> int:
    """Returns the number of free bytes on the file system that contains a folder."""
    return shutil.disk_usage(path).free


class FolderLock:
    """Exclusive lock on a folder, based on a lock file. The kernel releases it if the process ends.

    Args:
        path: path of the lock file, which is created if missing.
        wait: whether to wait until the lock is free; otherwise, BlockingIOError is raised if another process holds it.
    """

    def __init__(self, path: Path, *, wait: bool) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BaseException:
            os.close(self._file)
            raise

    def write(self, text: str) -> None:
        """Writes a human-readable note to the file, such as the holder's process ID."""
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, text.encode(), 0)

    def release(self) -> None:
        """Releases the lock."""
        os.close(self._file)


def lock_data(data: Path) -> FolderLock:
    """Locks the data folder for this service and creates the folder if missing.

    Raises:
        RuntimeError: another service is using the folder.
    """
    data.mkdir(parents=True, exist_ok=True)
    try:
        return FolderLock(DataFolder(data).lock, wait=False)
    except BlockingIOError:
        raise RuntimeError(f"another service is using {data}; stop it, or use another folder with --data") from None


def lock_states(folder: SceneFolder) -> FolderLock | None:
    """Waits until no other worker can commit to a scene's states, and locks them for this process.

    If the folder has an epoch, the function only records the ID of this process and returns None
    without waiting. A worker on another machine could hang while it holds a lock. The worker of
    each epoch therefore commits to its own folder instead (`server.storage.fencing`).
    """
    path = folder.worker_lock
    if folder.epoch is not None:
        beside = path.with_name(f"{path.name}.{folder.epoch}")
        with contextlib.suppress(OSError):
            beside.write_text(f"{os.getpid()}\n")
            beside.replace(path)
        return None
    # A killed service can leave behind a worker in the middle of an update; two workers must not commit to one history.
    lock = FolderLock(path, wait=True)
    with contextlib.suppress(OSError):  # the note is optional, so a full disk must not stop the worker
        lock.write(f"{os.getpid()}\n")
    return lock
