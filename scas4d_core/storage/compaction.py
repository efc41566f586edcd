"""Compaction: moves older states from their own files to chunks, frame by frame. Requires NumPy and zstandard.

The first and newest frames are kept bit-exact, because updates, replays and restarts depend on them. A frame is
appended to a chunk with its report as a note, the chunk is synced, and then the frame's own file is deleted. Every
frame therefore remains readable, no matter when the process ends. Renders of an older frame change at most once.
"""

from __future__ import annotations

import json
import logging
import os
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scas4d_core.compact import CompactWriter, FileError, FileHeader
from scas4d_core.gaussians import PER_FRAME, WHOLES, Gaussians
from scas4d_core.storage.births import Int
from scas4d_core.storage.chunks import REPORT, chunk_file, make_note
from scas4d_core.storage.faults import HistoryError, UnreadableFrameError
from scas4d_core.storage.frame_files import frame_of
from scas4d_core.storage.history import NEWEST_KEPT, History
from scas4d_core.storage.npz import sync_folder

CHUNK_FRAMES = 120
"""Maximum number of frames per chunk. The first state of a chunk is as large as five to ten others, which favours long
chunks. Retention deletes whole chunks, which favours short ones."""

NOT_ENCODED = (ValueError, ArithmeticError, MemoryError)
"""Exceptions for states that cannot be read or encoded, including the errors of histories and compact files."""

log = logging.getLogger("scas4d.storage")


@dataclass(frozen=True, eq=False)
class DueState:
    """A state to move to a chunk.

    Attributes:
        index: index of the frame.
        time: time of the frame in seconds.
        fixed: arguments of ``Gaussians`` that the file of the frame lacks; see ``HistoryReader.fixed_at``.
        log: [E, 4] event log up to the frame.
    """

    index: int
    time: float
    fixed: Mapping[str, Any]
    log: Int


class Compaction:
    """Compaction of a history, which moves its oldest exact states to chunks one step at a time.

    It must run in the process that appends to the history. A step consists of ``begin``, ``write`` and ``finish``.
    Only ``write`` takes long. It may run in another thread while frames are appended to the history.

    Args:
        history: history stored in a directory.
        head: function that returns the file header with the error bounds. It is called whenever a chunk is created or
            resumed.
        exact: number of newest states that are kept bit-exact, at least ``NEWEST_KEPT``.

    Attributes:
        exact: number of newest states that are kept bit-exact.

    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from scas4d_core.cameras import WorldFrame
    >>> from scas4d_core.gaussians import Gaussians
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     history = History(folder)
    ...     for index in range(6):
    ...         history.append(index, index / 30, state)
    ...     compaction = Compaction(history, lambda: FileHeader(WorldFrame(np.zeros(3))), exact=2)
    ...     moved = [compaction.step() for _ in range(4)]
    ...     compaction.close()
    ...     moved, sorted(path.name for path in history.directory.glob("[fs]*_00000[1-5].*"))
    ([1, 2, 3, None], ['frame_000004.npz', 'frame_000005.npz', 'states_000001.s4d'])
    """

    def __init__(self, history: History, head: Callable[[], FileHeader], exact: int) -> None:
        assert history.files is not None
        self.exact = max(exact, NEWEST_KEPT)
        self._history, self._files, self._head = history, history.files, head
        self._writer: CompactWriter | None = None
        self._first = -1
        """First frame of the current chunk."""
        self._closed: list[int] = []
        """First frame of each chunk that was completed since the last step."""
        self._passed = max(history.files.chunks, default=-1)
        """Last frame that is in a chunk or could not be moved."""
        self._queue: deque[int] = deque()
        """Frames to be moved, oldest first."""
        self._complete()

    @property
    def due(self) -> int:
        """Lower bound on the number of states to move, which is at least 1 if there are any."""
        if not self._queue:
            self._queue.extend(self._history.older_than_newest(self.exact, self._passed))
        return len(self._queue)

    def step(self) -> int | None:
        """Moves one state and returns the index of its frame, or None if there is no state to move.

        Raises:
            OSError: if the disk is full or failing. Nothing is lost, and the next step tries again.
        """
        while (due := self.begin()) is not None:
            state = due
            if self.finish(state, lambda: self.write(state)):  # noqa: B023 (called at once)
                return state.index
        return None

    def begin(self) -> DueState | None:
        """Returns the next state to move, or None if there is none."""
        history = self._history
        while self.due:
            index = self._queue[0]
            if index in history:
                return DueState(index, history.time(index), history.fixed_at(index), history.log_at(index))
            self._passed = self._queue.popleft()  # deleted by retention
        return None

    def finish(self, due: DueState, written: Callable[[], None]) -> bool:
        """Deletes the own file of a state that is in a chunk. A damaged or unencodable state keeps its file.

        Args:
            due: state that was passed to ``write``.
            written: function that returns once ``write`` has returned, or raises its error.

        Returns:
            Whether the state was moved.

        Raises:
            OSError: if the disk is full or failing. Nothing is lost, and the next step tries again.
        """
        moved = True
        try:
            written()
            self._delete_own_file(due.index)
        except OSError:
            self._release_writer()
            raise
        except NOT_ENCODED as error:
            log.warning("frame %d was not compacted: %s", due.index, error)
            self._release_writer()
            moved = False
            if isinstance(error, UnreadableFrameError):
                with suppress(HistoryError):
                    self._history.gaussians(due.index)  # records the damage
        self._passed = self._queue.popleft()
        return moved

    def close(self) -> None:
        """Closes the current chunk without completing it; another ``Compaction`` can resume it."""
        self._release_writer()

    def _complete(self) -> None:
        """Deletes leftover files of frames that an interrupted step had already moved to a chunk."""
        first = next(iter(self._history.indices), -1)
        names = map(frame_of, os.listdir(self._files.directory))
        own = [index for index in names if index is not None and index != first and index in self._files.chunks]
        for path in {chunk.path for index in own if (chunk := self._files.chunks.of(index)) is not None}:
            _confirm(path)
        for index in own:
            if self._files.chunks.fault(index) is None:
                self._files.path(index).unlink()
                self._history.mark_compacted(index)

    def write(self, due: DueState) -> None:
        """Appends a state to a chunk, and syncs the chunk.

        Raises:
            OSError: if the disk is full or failing.
            ValueError, ArithmeticError, MemoryError: if the state cannot be read or encoded.
        """
        index = due.index
        if self._writer is not None and self._first not in self._files.chunks.known:  # deleted by retention
            self._release_writer()
        state, report = self._read(due)
        writer = self._writer or self._resume_chunk()
        if writer is None or not self._fits(writer, index):
            self._close_chunk(writer)
            writer = self._begin_chunk(index)
        self._writer = writer
        if writer.last_frame < index:  # otherwise, only the last sync failed
            try:
                writer.add(index, due.time, state, note=make_note(report, due.log, writer.last_frame))
            except FileError:
                if not writer.frames:
                    self._release_writer()
                    writer.path.unlink(missing_ok=True)
                    raise
                self._close_chunk(writer)  # the Gaussians changed, so a new chunk may fit
                writer = self._writer = self._begin_chunk(index)
                writer.add(index, due.time, state, note=make_note(report, due.log, -1))
        writer.sync()

    def _read(self, due: DueState) -> tuple[Gaussians, dict[str, Any]]:
        """Reads a state and its report from disk. The history is not used, because it is not thread-safe."""
        try:
            frame = self._files.read(due.index, (*PER_FRAME, REPORT), WHOLES)
        except FileNotFoundError as error:
            raise UnreadableFrameError(f"frame {due.index} is missing") from error
        report = json.loads(frame.pop(REPORT).tobytes())
        return Gaussians(**frame, **due.fixed), report

    def _delete_own_file(self, index: int) -> None:
        chunks = self._files.chunks
        while self._closed:
            chunks.refresh_chunk(self._closed.pop())
        chunks.refresh_chunk(self._first)
        if index not in chunks:
            raise FileError(f"{chunk_file(self._first)}: frame {index} is missing after it was written")
        self._files.path(index).unlink(missing_ok=True)
        self._history.mark_compacted(index)

    def _fits(self, writer: CompactWriter, index: int) -> bool:
        return writer.last_frame == index or (writer.frames < CHUNK_FRAMES and writer.last_frame < index)

    def _resume_chunk(self) -> CompactWriter | None:
        """Returns a writer that resumes the newest chunk, or None if it is complete or has another header."""
        known = self._files.chunks.known
        if not known:
            return None
        self._first = max(known)
        try:
            writer = CompactWriter.resume(known[self._first].path)
        except NOT_ENCODED:
            return None
        if writer.head.text() != self._head().text():
            self._close_chunk(writer)
            return None
        return writer

    def _begin_chunk(self, index: int) -> CompactWriter:
        self._first = index
        path: Path = self._files.directory / chunk_file(index)
        path.unlink(missing_ok=True)  # left by an interruption, without a complete state
        writer = CompactWriter(path, self._head())
        sync_folder(path.parent)
        return writer

    def _close_chunk(self, writer: CompactWriter | None) -> None:
        """Completes a chunk by writing its index."""
        if writer is not None:
            writer.close()
            _confirm(writer.path)
            self._closed.append(self._first)
        self._writer = None

    def _release_writer(self) -> None:
        """Closes the current chunk without an index. An incomplete record is truncated when the chunk is resumed."""
        if self._writer is not None:
            self._writer.abandon()
        self._writer = None


def _confirm(path: Path) -> None:
    """Syncs a file and its folder entry to disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
    sync_folder(path.parent)
