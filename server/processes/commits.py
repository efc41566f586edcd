"""Writing of commits by a thread, in order, while the next frame is being updated.

At most one commit is being written. The next one waits for it, so memory is bounded, and a slow disk slows the updates
down.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from scas4d_core.errors import message_of
from server.messages import FrameCommitted, WaitingForDisk
from server.storage.disk import no_room

STALL_S, LONGEST_STALL_S = 1.0, 30.0
"""Initial and maximum delay in seconds between attempts to write a commit while the disk is full."""

log = logging.getLogger("scas4d.worker")


@dataclass(eq=False)
class PendingCommit:
    """A frame whose state is in memory and must be written.

    Attributes:
        index: index of the frame.
        writes: functions that write the files, in order. Each may be called again if it raises an error.
        message: message to send once all files are synced.
        cleanups: functions that delete earlier checkpoints after the message was sent.
        deletions: functions that delete files that are no longer needed once all files are synced.
    """

    index: int
    writes: list[Callable[[], None]] = field(default_factory=list)
    message: FrameCommitted | None = None
    cleanups: list[Callable[[], None]] = field(default_factory=list)
    deletions: list[Callable[[], None]] = field(default_factory=list)


class CommitError(RuntimeError):
    """Error raised if a commit cannot be written although the disk is not full."""


class CommitWriter:
    """Thread that writes commits and reports them to the service.

    Args:
        send: sends a message to the service.
        fail: called with a `CommitError`. The worker must then exit, because its state in memory is ahead of the files.
        name: name of the scene, for the log.

    Attributes:
        write_seconds: seconds that the last commit took to write; None before the first one.
        publish_seconds: seconds that the last message took to send.
    """

    def __init__(self, send: Callable[[Any], None], fail: Callable[[BaseException], None], name: str) -> None:
        self._send, self._fail, self._name = send, fail, name
        self._idle = threading.Event()
        self._idle.set()
        self._written: PendingCommit | None = None
        self.write_seconds: float | None = None
        self.publish_seconds = 0.0

    def wait(self, seconds: float | None) -> bool:
        """Waits until nothing is being written, at most the given time, and returns whether that is the case."""
        return self._idle.wait(seconds)

    def put(self, commit: PendingCommit) -> None:
        """Starts to write a commit; call it only if nothing is being written."""
        self.delete_files()
        self._idle.clear()
        threading.Thread(target=self._write, args=(commit,), daemon=True, name="commit").start()

    def delete_files(self) -> None:
        """Deletes the files that the last commit made unnecessary; call it only if nothing is being written."""
        commit, self._written = self._written, None
        if commit is not None:
            for delete in commit.deletions:
                delete()

    def _write(self, commit: PendingCommit) -> None:
        began = time.perf_counter()
        try:
            for write in commit.writes:
                self._write_when_there_is_room(commit.index, write)
            sending = time.perf_counter()
            self.write_seconds = sending - began
            with contextlib.suppress(OSError):  # the service is gone, which the inbox notices
                self._send(commit.message)
            self.publish_seconds = time.perf_counter() - sending
            for clean in commit.cleanups:
                clean()
        except BaseException as error:
            failure = CommitError(f"frame {commit.index} cannot be committed: {message_of(error)}")
            failure.__cause__ = error
            self._fail(failure)
            return  # nothing may be written after it
        self._written = commit
        self._idle.set()

    def _write_when_there_is_room(self, index: int, write: Callable[[], None]) -> None:
        stall = STALL_S
        while True:
            try:
                write()
                return
            except Exception as error:  # a full disk can surface as another error, such as one from closing a zip file
                if not no_room(error):
                    raise
                log.warning("scene %s: cannot commit frame %d yet: %s", self._name, index, error)
                self._send(WaitingForDisk(index, message_of(error), stall))
            time.sleep(stall)
            stall = min(2 * stall, LONGEST_STALL_S)
