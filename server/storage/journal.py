"""Journal of a scene: one append-only file of events. An event is acknowledged once it is on disk.

If the file is deleted or replaced while the service is running, events appended to the open
descriptor would be lost. Each write therefore checks that the path still refers to the open file.
If the path refers to another file, or if a scrub finds damage, the journal is rewritten from the
ledger (`snapshot`). The new journal is written to a temporary file, which is then renamed.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pydantic import ValidationError

from scas4d_core.storage.npz import open_atomically, sync_folder
from server.problems import Problem
from server.storage.disk import no_room
from server.storage.events import JournalEvent, SceneCreated, WorkerDied, event_fault, parse_event
from server.storage.record_log import Damage, LogRecordKind, encode_record, stream_records

PIECE = 1 << 16
"""Number of bytes verified per step."""
EVENTS_AT_ONCE = 1000
"""Number of events encoded per write when a complete journal is written."""

Snapshot = Callable[[], Iterator[JournalEvent]]
"""Function that returns all known events. It is called on the event loop; another thread may consume the iterator."""


@dataclass(frozen=True)
class JournalReading:
    """Result of reading a journal.

    Attributes:
        good: size of the journal in bytes, without a torn tail.
        damage: one sentence per damaged region.
        broken: whether there is damage other than a torn tail, so that events may be lost.
        begun: whether the first event is `SceneCreated`.
    """

    good: int
    damage: list[str]
    broken: bool = False
    begun: bool = False


def replay(path: Path, take: Callable[[JournalEvent], object]) -> JournalReading:
    """Calls `take` with every intact event, in order.

    The file is read in pieces, and damaged content never raises an error. An interrupted append leaves a torn tail,
    which is dropped because it was never acknowledged.
    """
    damage: list[str] = []
    broken = False
    begun: bool | None = None
    try:
        opened = path.open("rb")
    except FileNotFoundError:
        return JournalReading(0, damage)
    with opened as file:
        good = os.fstat(file.fileno()).st_size
        for record in stream_records(file):
            if isinstance(record, Damage):
                if record.torn:
                    good = record.start
                broken |= not record.torn
                damage.append(f"{path.name}: dropped bytes {record.start} to {record.end}: {record.reason}")
                continue
            try:
                event = parse_event(record.text)
            except ValidationError as error:
                fault = event_fault(error)
                broken = True
                damage.append(f"{path.name}: invalid event of kind {record.kind}, frame {record.index}: {fault}")
                continue
            begun = isinstance(event, SceneCreated) if begun is None else begun
            take(event)
    return JournalReading(good, damage, broken, bool(begun))


def encode_events(events: Iterable[JournalEvent]) -> bytes:
    """Encodes events as consecutive records."""
    return b"".join(
        encode_record(LogRecordKind.EVENT, _index(event), event.model_dump(mode="json")) for event in events
    )


def write_journal(path: Path, events: Iterator[JournalEvent]) -> int:
    """Writes a complete journal to `path` and atomically replaces an existing file. Blocks.

    Returns:
        The size of the journal in bytes.

    Raises:
        OSError: the journal could not be written; the existing file is unchanged.
    """
    beside = path.with_name(f".{path.name}.part")
    size, batch = 0, []
    with open_atomically(path, beside) as file:
        for event in events:
            batch.append(event)
            if len(batch) == EVENTS_AT_ONCE:
                size += file.write(encode_events(batch))
                batch = []
        size += file.write(encode_events(batch))
    return size


class _FirstBytes:
    """Reader that is limited to the first bytes of a file."""

    def __init__(self, file: BinaryIO, left: int) -> None:
        self._file = file
        self._left = left

    def read(self, size: int) -> bytes:
        piece = self._file.read(min(size, self._left))
        self._left -= len(piece)
        return piece


def verify_journal(path: Path, good: int) -> Iterator[int]:
    """Verifies the first `good` bytes of a journal and yields the number of bytes verified in each step.

    Raises:
        FileNotFoundError: the journal is missing.
        ValueError: the bytes are not a sequence of intact records.
    """
    read = since = 0
    with path.open("rb") as file:
        for record in stream_records(_FirstBytes(file, good)):
            if isinstance(record, Damage):
                raise ValueError(f"bytes {record.start} to {record.end}: {record.reason}")
            read += record.size
            since += record.size
            if since >= PIECE:
                yield since
                since = 0
    if read != good:
        raise ValueError(f"only {read} of {good} bytes exist")
    yield since


class Journal:
    """Append-only event journal. Events that arrive during a write share the next write.

    Args:
        path: path of the journal, which is created if missing.
        good: number of bytes to keep; the rest of the file is truncated.
        snapshot: function that returns all known events, to rewrite the journal. If None, it is never rewritten.
        on_rewritten: function called with the fault after each rewrite of the journal.
    """

    def __init__(
        self,
        path: Path,
        good: int = 0,
        snapshot: Snapshot | None = None,
        on_rewritten: Callable[[str], None] = lambda fault: None,
    ) -> None:
        self.path = path
        self._snapshot = snapshot
        self._on_rewritten = on_rewritten
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        self._good = good
        self._closed = False
        os.ftruncate(self._file, good)
        os.fsync(self._file)
        sync_folder(path.parent)
        self._waiting: list[tuple[Sequence[JournalEvent], asyncio.Future[None]]] = []
        self._last: list[JournalEvent] = []
        """Events of the last write, which may not have been applied to the ledger yet."""
        self._fault: str | None = None
        self._flushing: asyncio.Task[None] | None = None

    @property
    def file_position(self) -> tuple[int, int]:
        """Inode of the file, which changes with a rewrite, and the size of the journal in bytes."""
        return os.fstat(self._file).st_ino, self._good

    async def append(self, *events: JournalEvent) -> None:
        """Appends events and returns once all of them are on disk.

        Raises:
            OSError: none of the events is on disk; the file is unchanged.
            Problem: 503 if the journal is closed.
        """
        if self._closed:
            raise Problem(503, "the scene was closed", remedy="try again; a deleted scene then returns 404")
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((events, done))
        self._begin()
        await asyncio.shield(done)

    def rewrite(self, fault: str) -> None:
        """Schedules a rewrite of a damaged journal, serialised with appends; `fault` describes the damage."""
        if not self._closed and self._snapshot is not None:
            self._fault = fault
            self._begin()

    def rewrite_if_moved(self) -> None:
        """Schedules a rewrite if the file was moved, replaced or truncated; does nothing during a write."""
        if self._flushing is None and not self._closed and (fault := self.file_fault()) is not None:
            self.rewrite(fault)

    def file_fault(self) -> str | None:
        """Returns how the file at the path differs from the open one, or None if it is the same and not truncated."""
        try:
            there, own = os.stat(self.path), os.fstat(self._file)
        except FileNotFoundError:
            return f"{self.path.name} is missing"
        if (there.st_dev, there.st_ino) != (own.st_dev, own.st_ino):
            return f"{self.path.name} was replaced by another file"
        if there.st_size < self._good:
            return f"{self.path.name} is truncated to {there.st_size} of {self._good} bytes"
        return None

    def _begin(self) -> None:
        if self._flushing is None:
            self._flushing = asyncio.create_task(self._flush())

    async def _flush(self) -> None:
        try:
            while self._waiting or self._fault is not None:
                batch, self._waiting = self._waiting, []
                events = [event for some, _ in batch for event in some]
                fault: Exception | None = None
                try:
                    if self._fault is None:
                        self._fault = await asyncio.to_thread(self._write, events)
                    if self._fault is not None:
                        await self._rewrite_or_append(events)
                except Exception as error:  # any error must reach the waiting callers
                    fault = error
                else:
                    self._last = events or self._last
                for _, done in batch:
                    if done.done():
                        continue
                    if fault is None:
                        done.set_result(None)
                    else:
                        done.set_exception(fault)
                        done.exception()  # marks it as retrieved: the caller may have been cancelled
                if fault is not None and not batch and not self._waiting:
                    break  # the next event retries
        finally:
            self._flushing = None

    def _write(self, events: Sequence[JournalEvent]) -> str | None:
        """Appends events; returns None, or a fault if they are not in the file at the journal's path."""
        watched = self._snapshot is not None
        if watched and (fault := self.file_fault()) is not None:
            return fault
        data = encode_events(events)
        view = memoryview(data)
        try:
            while view:
                view = view[os.pwrite(self._file, view, self._good + len(data) - len(view)) :]
            os.fsync(self._file)
        except OSError:
            os.ftruncate(self._file, self._good)  # a partial record must not precede a complete one
            raise
        self._good += len(data)
        return self.file_fault() if watched else None

    async def _rewrite_or_append(self, events: Sequence[JournalEvent]) -> None:
        """Rewrites the journal with the given events added.

        If the disk is too full for a rewrite, the events are appended to the damaged journal
        instead, provided that the open file is still at its path. Otherwise, the frame that waits
        for the write would be refused and lost. The next scrub finds the damage again.
        """
        try:
            await self._rewrite(events)
        except OSError as error:
            if not no_room(error) or self.file_fault() is not None:
                raise
            self._fault = None
            if events and (fault := await asyncio.to_thread(self._write, events)) is not None:
                self._fault = fault
                raise

    async def _rewrite(self, events: Sequence[JournalEvent]) -> None:
        """Rewrites the journal with the snapshot, followed by the events that the snapshot may lack."""
        assert self._snapshot is not None
        assert self._fault is not None
        snapshot = self._snapshot()
        # Replaying an event twice is harmless, except for `WorkerDied`, which would be counted twice. Its caller
        # applies it right after the write, so the snapshot already has it.
        last = [event for event in self._last if not isinstance(event, WorkerDied)]
        self._good = await asyncio.to_thread(self._replace, snapshot, [*last, *events])
        fault, self._fault = self._fault, None
        self._on_rewritten(fault)

    def _replace(self, snapshot: Iterator[JournalEvent], behind: Sequence[JournalEvent]) -> int:
        def all_events() -> Iterator[JournalEvent]:
            yield from snapshot
            yield from behind

        size = write_journal(self.path, all_events())
        file = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        os.close(self._file)
        self._file = file
        return size

    async def close(self) -> None:
        """Waits for the current write and closes the file.

        Later writes are refused, because another file may reuse the descriptor.
        """
        self._closed = True
        while self._flushing is not None:
            await asyncio.wait([self._flushing])
        os.close(self._file)


def _index(event: JournalEvent) -> int:
    frames: Sequence[int] = getattr(event, "frames", ())
    return int(getattr(event, "index", frames[0] if frames else 0))
