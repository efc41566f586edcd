"""Compaction: older states go from files of their own to chunks, frame by frame. Numpy, zstandard.

The first frame and the newest stay exact: updates, replays and a restart need their bits. A frame is appended to a
chunk and synced, with its report as the note, and then its own file goes: whatever ends the process meanwhile, each
frame is read, and what a chunk holds is the same bytes. A past view changes once at most.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Callable
from pathlib import Path

from scas4d_core.compact import CompactWriter, FileError, FileHeader
from scas4d_core.storage.chunks import chunk_file, make_note
from scas4d_core.storage.frame_files import frame_of
from scas4d_core.storage.history import NEWEST_KEPT, History
from scas4d_core.storage.npz import sync_folder

CHUNK_FRAMES = 120
"""Frames of a chunk: its first state takes as much as five to ten of the others, and retention deletes it whole."""

NOT_ENCODED = (ValueError, ArithmeticError, MemoryError)
"""Errors of states that cannot be read or encoded: those of histories and of compact files are ValueErrors."""

log = logging.getLogger("scas4d.storage")


class Compaction:
    """Moves the oldest exact states of a history to chunks. For the process that appends to it.

    Args:
        history: in a directory. head: returns what holds for all states, bounds included; asked when a chunk begins.
        exact: the newest states that stay as they are, ``NEWEST_KEPT`` at least.

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
        """First frame of the chunk that is written."""
        self._passed = max(history.files.chunks, default=-1)
        """The last frame that is in a chunk, or that cannot be."""
        self._queue: deque[int] = deque()
        """Frames to move, the oldest first."""
        self._complete()

    @property
    def due(self) -> int:
        """Number of states to be moved, as far as is known: at least one where any is."""
        if not self._queue:
            self._queue.extend(self._history.older_than_newest(self.exact, self._passed))
        return len(self._queue)

    def step(self) -> int | None:
        """Moves one state; returns its frame, or None where none is due.

        Raises:
            OSError: the disk is full, or fails; nothing is lost, and the next step tries again.
        """
        while self.due:
            index = self._queue[0]
            try:
                if index in self._history:  # retention may have deleted it
                    self._move(index)
            except OSError:
                self._release_writer()
                raise
            except NOT_ENCODED as error:  # damaged, or it cannot be encoded: it stays as it is
                log.warning("frame %d is not compacted: %s", index, error)
                self._release_writer()
            else:
                self._passed = self._queue.popleft()
                return index
            self._passed = self._queue.popleft()
        return None

    def close(self) -> None:
        """Leaves the chunk that is being written as it is; another ``Compaction`` goes on with it."""
        self._release_writer()

    def _complete(self) -> None:
        """Deletes files of frames that are in a chunk, whole and on disk: a stop left them beside it."""
        first = next(iter(self._history.indices), -1)
        names = map(frame_of, os.listdir(self._files.directory))
        own = [index for index in names if index is not None and index != first and index in self._files.chunks]
        for path in {chunk.path for index in own if (chunk := self._files.chunks.of(index)) is not None}:
            _confirm(path)
        for index in own:
            if self._files.chunks.fault(index) is None:
                self._files.path(index).unlink()
                self._history.mark_compacted(index)

    def _move(self, index: int) -> None:
        history, files = self._history, self._files
        if self._writer is not None and self._first not in files.chunks.known:  # retention has deleted it
            self._release_writer()
        state, time = history.gaussians(index), history.time(index)
        report, log = history.report(index), history.log_at(index)
        writer = self._writer or self._resume_chunk()
        if writer is None or not self._fits(writer, index):
            self._finish(writer)
            writer = self._begin_chunk(index)
        self._writer = writer
        if writer.last_frame < index:  # else the disk did not confirm it the last time
            try:
                writer.add(index, time, state, note=make_note(report, log, writer.last_frame))
            except FileError:
                if not writer.frames:
                    self._release_writer()
                    writer.path.unlink(missing_ok=True)
                    raise
                self._finish(writer)  # other Gaussians than before: a chunk of its own may hold it
                writer = self._writer = self._begin_chunk(index)
                writer.add(index, time, state, note=make_note(report, log, -1))
        writer.sync()
        files.chunks.refresh_chunk(self._first)
        if index not in files.chunks:
            raise FileError(f"{writer.path.name}: frame {index} is not in it after it was written")
        files.path(index).unlink(missing_ok=True)
        history.mark_compacted(index)

    def _fits(self, writer: CompactWriter, index: int) -> bool:
        return writer.last_frame == index or (writer.frames < CHUNK_FRAMES and writer.last_frame < index)

    def _resume_chunk(self) -> CompactWriter | None:
        """The newest chunk, to go on with, where it has not ended and was begun with the same bounds."""
        known = self._files.chunks.known
        if not known:
            return None
        self._first = max(known)
        try:
            writer = CompactWriter.resume(known[self._first].path)
        except NOT_ENCODED:
            return None
        if writer.head.text() != self._head().text():
            self._finish(writer)
            return None
        return writer

    def _begin_chunk(self, index: int) -> CompactWriter:
        self._first = index
        path: Path = self._files.directory / chunk_file(index)
        path.unlink(missing_ok=True)  # one without a whole state: a stop came between its beginning and its end
        writer = CompactWriter(path, self._head())
        sync_folder(path.parent)
        return writer

    def _finish(self, writer: CompactWriter | None) -> None:
        """Ends a chunk with its index."""
        if writer is not None:
            writer.close()
            _confirm(writer.path)
            self._files.chunks.refresh()
        self._writer = None

    def _release_writer(self) -> None:
        """Lets go of the chunk that is being written; a half-written record is cut off when it is gone on with."""
        if self._writer is not None:
            self._writer.abandon()
        self._writer = None


def _confirm(path: Path) -> None:
    """Has the disk confirm a file, and that it is in its folder."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
    sync_folder(path.parent)
