"""What the disk can say: that it is full, and that somebody else is at work in a folder."""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path

from scas4d_core.errors import told
from server.problems import Problem

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors that go away once there is room."""


def no_room(error: BaseException | None) -> bool:
    """Whether an error says that the disk is full, or came up while such a one was handled (as zipfile's do)."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in NO_ROOM:
            return True
        error = error.__cause__ or error.__context__
    return False


def full_disk(error: Exception) -> Problem:
    """The answer where there is no room."""
    return Problem(
        507,
        f"the disk has no room: {told(error)}",
        remedy="free room in the service's data folder, or shorten the scene's retention, and send the same again",
        headers={"Retry-After": "5"},
    )


class FolderLock:
    """Held by one process at a time; the kernel lets it go when that ends, however it ends.

    Args:
        path: of the lock's file, made where there is none.
        wait: until it is free; otherwise BlockingIOError where another holds it.
    """

    def __init__(self, path: Path, *, wait: bool) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BaseException:
            os.close(self._file)
            raise

    def write(self, text: str) -> None:
        """Puts something in the file for people, such as who holds it."""
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, text.encode(), 0)

    def release(self) -> None:
        """Lets it go."""
        os.close(self._file)
