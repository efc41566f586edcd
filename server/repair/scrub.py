"""Scrubbing of a scene: slowly rereads all files and verifies their checksums.

Scrubbing finds damage before a file is needed. Files are read sequentially in pieces in a thread.
Pauses limit the read rate to the configured value, or to a quarter of it while a frame is being
updated. Pages that only the scrub needed are dropped from the page cache.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from client.wire import FrameState
from scas4d_core.compact import checked_records
from scas4d_core.errors import message_of
from scas4d_core.storage.chunks import Chunk
from scas4d_core.storage.frame_files import (
    FIRST_COPY,
    FIXED_COPY,
    FIXED_FILE,
    FrameFiles,
    born_file,
    checkpoint_file,
    checkpoint_of,
)
from scas4d_core.storage.history import FRAMES_KEPT
from scas4d_core.storage.npz import iter_verified
from server import counters
from server.repair.repair_queue import DamageKind, DamageLog, RepairQueue
from server.storage.definition import Definition, check_definition, write_definition
from server.storage.frame_store import verify_record
from server.storage.journal import verify_journal
from server.storage.layout import SceneFolder
from server.storage.ledger import SceneLog

AT_WORK = 0.25
"""Fraction of the read rate that is used while a frame is being updated."""
EVENT_WEIGHT = 8
"""CPU cost per byte of the journal relative to arrays; it is higher because the journal has many small records."""
CHECK_S = 5.0
"""Interval in seconds between checks that the journal file is still at its path."""

GONE = "gone"
"""Fault of a missing file."""

log = logging.getLogger("scas4d.server")


class Scrub:
    """Periodic scrubbing of one scene.

    Args:
        definition: scene definition.
        folder: scene folder.
        log: the scene's journal, ledger and frame log.
        damage: the scene's damage messages.
        mending: the scene's repair queue.
        mb_per_second: maximum read rate in MB/s; 0 disables scrubbing.
        pause_seconds: pause before each pass, in seconds.
    """

    def __init__(
        self,
        definition: Definition,
        folder: SceneFolder,
        log: SceneLog,
        damage: DamageLog,
        mending: RepairQueue,
        *,
        mb_per_second: float,
        pause_seconds: float,
    ) -> None:
        self._definition = definition
        self._folder = folder
        self._ledger = log.ledger
        self._journal = log.journal
        self._damage = damage
        self._repair_queue = mending
        self._bytes_per_second = 1e6 * mb_per_second
        self._pause = pause_seconds

    async def run(self) -> None:
        """Scrubs the scene repeatedly until cancelled."""
        while True:
            left = self._pause
            while left > 0 or self._bytes_per_second == 0:
                await asyncio.sleep(min(left, CHECK_S) if left > 0 else CHECK_S)
                left -= CHECK_S
                self._journal.rewrite_if_moved()
            try:
                await self.once()
            except Exception:  # a failed scrub must not stop the scene
                log.exception("cannot scrub scene %s", self._folder.name)

    async def once(self) -> None:
        """Runs one pass over all files."""
        await self._scrub_definition()
        await self._scrub_journal()
        await self._scrub_states()
        await self._scrub_points()
        await self._scrub_frames()

    async def _read(self, pieces: Iterator[int], weight: int = 1) -> str | None:
        """Reads a file to its end, at a limited rate.

        Args:
            pieces: iterator that reads and verifies the file, and yields the size of each piece.
            weight: factor by which the pauses are longer than for a file of arrays.

        Returns:
            The fault of the file, `GONE` if the file is missing, or None if the file is intact.
        """
        try:
            while (size := await asyncio.to_thread(next, pieces, None)) is not None:
                counters.SCRUBBED.inc(size)
                rate = self._bytes_per_second * (AT_WORK if self._ledger.updating else 1.0)
                await asyncio.sleep(weight * size / rate)
        except (OSError, ValueError) as error:
            return GONE if isinstance(error, FileNotFoundError) else message_of(error)
        return None

    async def _scrub_definition(self) -> None:
        fault = await asyncio.to_thread(check_definition, self._folder)
        if fault is None:
            return
        with contextlib.suppress(OSError):  # the next pass retries
            await asyncio.to_thread(write_definition, self._folder, self._definition)
            self._damage.add(DamageKind.DEFINITION, f"{fault}; it was rewritten")

    async def _scrub_journal(self) -> None:
        journal = self._journal
        journal.rewrite_if_moved()
        file, good = journal.file_position
        fault = await self._read(verify_journal(journal.path, good), EVENT_WEIGHT)
        if (
            fault is not None and fault != GONE and journal.file_position[0] == file
        ):  # otherwise the journal was rewritten during the scrub
            journal.rewrite(f"{journal.path.name} is damaged ({fault})")

    async def _scrub_states(self) -> None:
        ledger, folder = self._ledger, self._folder.states
        committed = list(ledger.committed)
        if not committed:
            return
        for name in (FIXED_FILE, FIXED_COPY, FIRST_COPY):
            await self._state(folder / name, lambda: True)
        files = FrameFiles(folder)
        for index in await asyncio.to_thread(files.births):
            for copy in (False, True):
                await self._state(folder / born_file(index, copy), lambda: True)
        listed = await asyncio.to_thread(_checkpoint_names, folder)
        for name in listed:
            await self._state(folder / name, lambda: False)
        newest = checkpoint_file(ledger.committed[-1])
        if listed and not self._ledger.updating and not await asyncio.to_thread((folder / newest).exists):
            self._repair_queue.report_damage({newest: f"{newest} is missing"})
        await asyncio.to_thread(files.chunks.refresh)
        for index in reversed(committed):
            if index in files.chunks and not files.path(index).exists():
                continue
            await self._state(files.path(index), partial(self._expected, files, index))
            if index not in committed[-FRAMES_KEPT:]:
                await asyncio.to_thread(_drop_page_cache, files.path(index))
        for chunk in list(files.chunks.known.values()):
            if await self._read(checked_records(chunk.path)) not in (None, GONE):
                await self._scrub_frames_of(files, chunk)
            await asyncio.to_thread(_drop_page_cache, chunk.path)

    async def _scrub_frames_of(self, files: FrameFiles, chunk: Chunk) -> None:
        """Reports the unreadable frames of a damaged chunk to the repair queue."""
        for index in chunk.frames:
            fault = await asyncio.to_thread(files.chunks.fault, index)
            if fault is not None and index in self._ledger.committed and not files.path(index).exists():
                self._repair_queue.report_damage({files.path(index).name: fault})

    def _expected(self, files: FrameFiles, index: int) -> bool:
        """Returns whether a frame should still have its own file: it is committed and has not moved to a chunk."""
        if index in self._ledger.committed:
            files.chunks.refresh()
            return index not in files.chunks
        return False

    async def _state(self, path: Path, expected: Callable[[], bool]) -> None:
        """Scrubs one state file; `expected` returns whether the file's absence counts as damage."""
        fault = await self._read(iter_verified(path))
        if fault == GONE and await asyncio.to_thread(expected):
            self._repair_queue.report_damage({path.name: f"{path.name} is missing"})
        elif fault is not None and fault != GONE:
            self._repair_queue.report_damage({path.name: fault})

    async def _scrub_points(self) -> None:
        path = self._folder.points
        fault = await self._read(iter_verified(path))
        if fault is None or fault == GONE:
            return
        used = (
            "it is no longer needed, because the first frame is committed"
            if self._ledger.committed
            else "upload the points again"
        )
        self._damage.add(DamageKind.POINTS, f"{fault}; {used}", lasting=True)

    async def _scrub_frames(self) -> None:
        names = [(entry.index, name) for entry in self._ledger.frames.with_pictures() for name in entry.files]
        for index, name in names:
            fault = await self._read(verify_record(self._folder.frames, name))
            await asyncio.to_thread(_drop_page_cache, self._folder.frames / name)
            entry = self._ledger.frames.get(index)
            if fault is None or entry is None or name not in entry.files:  # deleted during the scrub
                continue
            what = "the frame will fail when it is processed"
            if entry.state == FrameState.COMMITTED:
                what = "its state is not affected"
            sentence = f"frame {index}: its record in the frame log is damaged: {fault}; {what}"
            self._damage.add(DamageKind.FRAME, sentence, lasting=True)


def _checkpoint_names(folder: Path) -> list[str]:
    try:
        return sorted(entry.name for entry in os.scandir(folder) if checkpoint_of(entry.name) is not None)
    except FileNotFoundError:
        return []


def _drop_page_cache(path: Path) -> None:
    """Drops a file from the page cache, because nothing else is expected to read it soon."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
