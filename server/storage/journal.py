"""Journal of a scene: one append-only file of events. An event is acknowledged when it is on disk.

A file that is deleted or replaced while the service runs would receive events that nobody finds again: each write
checks that the file still has its name. If it has not, or if a scrub finds it damaged, the journal is written anew from
the ledger (`snapshot`), beside its place, and renamed.
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
from server.storage.events import JournalEvent, SceneCreated, WorkerDied, parse_event, why_no_event
from server.storage.record_log import Damage, LogRecordKind, encoded, streamed

PIECE = 1 << 16
"""Bytes that are compared at a time."""
TOGETHER = 1000
"""Events that are encoded at a time where a whole journal is written."""

Snapshot = Callable[[], Iterator[JournalEvent]]
"""Called on the event loop; the events may be read in another thread."""


@dataclass(frozen=True)
class JournalContent:
    """Content of a journal: its events in order, the bytes that are whole, and a sentence for each damage."""

    events: list[JournalEvent]
    good: int
    damage: list[str]


def read_journal(path: Path) -> JournalContent:
    """Reads a whole journal that is not large; see `replay`."""
    events: list[JournalEvent] = []
    reading = replay(path, events.append)
    return JournalContent(events, reading.good, reading.damage)


@dataclass(frozen=True)
class JournalReading:
    """Result of reading a journal: the bytes that are whole, and a sentence for each damage.

    `broken`: more than a torn tail is damaged; events may be lost. `begun`: its first event is `SceneCreated`.
    """

    good: int
    damage: list[str]
    broken: bool = False
    begun: bool = False


def replay(path: Path, take: Callable[[JournalEvent], object]) -> JournalReading:
    """Calls `take` with every whole event, in order, reading piece by piece; never raises for the file's content.

    An append that was cut short leaves a torn tail: it was never acknowledged, and it is dropped.
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
        for record in streamed(file):
            if isinstance(record, Damage):
                if record.torn:
                    good = record.start
                broken |= not record.torn
                damage.append(f"{path.name}: bytes {record.start} to {record.end} dropped: {record.reason}")
                continue
            try:
                event = parse_event(record.text)
            except ValidationError as error:
                fault = why_no_event(error)
                broken = True
                damage.append(
                    f"{path.name}: a record of kind {record.kind}, frame {record.frame}, is no event: {fault}"
                )
                continue
            begun = isinstance(event, SceneCreated) if begun is None else begun
            take(event)
    return JournalReading(good, damage, broken, bool(begun))


def bytes_of(events: Iterable[JournalEvent]) -> bytes:
    """Encodes events as records, one after the other."""
    return b"".join(encoded(LogRecordKind.EVENT, _index(event), event.model_dump(mode="json")) for event in events)


def write_journal(path: Path, events: Iterator[JournalEvent]) -> int:
    """Writes a whole journal at `path`, in place of the file there; blocking.

    Returns:
        Its size in bytes.

    Raises:
        OSError: it could not be written; the file that was there stays.
    """
    beside = path.with_name(f".{path.name}.part")
    size, batch = 0, []
    with open_atomically(path, beside) as file:
        for event in events:
            batch.append(event)
            if len(batch) == TOGETHER:
                size += file.write(bytes_of(batch))
                batch = []
        size += file.write(bytes_of(batch))
    return size


class _Beginning:
    """The first bytes of a file, as a file."""

    def __init__(self, file: BinaryIO, left: int) -> None:
        self._file = file
        self._left = left

    def read(self, size: int) -> bytes:
        piece = self._file.read(min(size, self._left))
        self._left -= len(piece)
        return piece


def checked_journal(path: Path, good: int) -> Iterator[int]:
    """Reads the first bytes of a journal again; yields the number of bytes of each piece.

    Raises:
        FileNotFoundError: the journal is gone. ValueError: not all of the bytes are whole records.
    """
    read = since = 0
    with path.open("rb") as file:
        for record in streamed(_Beginning(file, good)):
            if isinstance(record, Damage):
                raise ValueError(f"bytes {record.start} to {record.end}: {record.reason}")
            read += record.size
            since += record.size
            if since >= PIECE:
                yield since
                since = 0
    if read != good:
        raise ValueError(f"{read} of {good} bytes are there")
    yield since


class Journal:
    """Appends events. Those that arrive while one write is under way share the next one.

    Args:
        path: of the file; made when missing.
        good: bytes of it that are whole; the rest is cut off.
        snapshot: returns all events that are known now, to write the journal anew; None: it is never written anew.
        renewed: called with the fault each time that it was written anew.
    """

    def __init__(
        self,
        path: Path,
        good: int = 0,
        snapshot: Snapshot | None = None,
        renewed: Callable[[str], None] = lambda fault: None,
    ) -> None:
        self.path = path
        self._snapshot = snapshot
        self._renewed = renewed
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        self._good = good
        self._closed = False
        os.ftruncate(self._file, good)
        os.fsync(self._file)
        sync_folder(path.parent)
        self._waiting: list[tuple[Sequence[JournalEvent], asyncio.Future[None]]] = []
        self._last: list[JournalEvent] = []
        """Events that were written last: the ledger may not have applied them yet."""
        self._fault: str | None = None
        self._flushing: asyncio.Task[None] | None = None

    @property
    def place(self) -> tuple[int, int]:
        """Inode of the file, which changes when it is written anew, and the bytes of it that are whole."""
        return os.fstat(self._file).st_ino, self._good

    async def append(self, *events: JournalEvent) -> None:
        """Returns when the events are on disk, all of them.

        Raises:
            OSError: none of them is on disk; the file is as it was.
            Problem: 503, the journal is closed.
        """
        if self._closed:
            raise Problem(503, "the scene has ended", remedy="ask again: a scene that was deleted is not found then")
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((events, done))
        self._begin()
        await asyncio.shield(done)

    def renew(self, fault: str) -> None:
        """Writes the journal anew because it was found damaged, in turn with appends. `fault`: a sentence."""
        if not self._closed and self._snapshot is not None:
            self._fault = fault
            self._begin()

    def look(self) -> None:
        """Writes the journal anew where its file has lost its name; does nothing during a write."""
        if self._flushing is None and not self._closed and (fault := self.misplaced()) is not None:
            self.renew(fault)

    def misplaced(self) -> str | None:
        """Checks that the open file still has its name and its bytes; returns the fault, or None."""
        try:
            there, own = os.stat(self.path), os.fstat(self._file)
        except FileNotFoundError:
            return f"{self.path.name} is gone"
        if (there.st_dev, there.st_ino) != (own.st_dev, own.st_ino):
            return f"another file has taken the place of {self.path.name}"
        if there.st_size < self._good:
            return f"{self.path.name} has {there.st_size} of {self._good} bytes"
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
                        await self._renew_or_append(events)
                except Exception as error:  # of any kind: the callers that wait must get it
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
                        done.exception()  # the caller may be gone: not a fault of the event loop
                if fault is not None and not batch and not self._waiting:
                    break  # the next event tries again
        finally:
            self._flushing = None

    def _write(self, events: Sequence[JournalEvent]) -> str | None:
        """Appends; returns a fault where the file has lost its name: then the events are not in the journal."""
        watched = self._snapshot is not None
        if watched and (fault := self.misplaced()) is not None:
            return fault
        data = bytes_of(events)
        view = memoryview(data)
        try:
            while view:
                view = view[os.pwrite(self._file, view, self._good + len(data) - len(view)) :]
            os.fsync(self._file)
        except OSError:
            os.ftruncate(self._file, self._good)  # half a record must not stand before a whole one
            raise
        self._good += len(data)
        return self.misplaced() if watched else None

    async def _renew_or_append(self, events: Sequence[JournalEvent]) -> None:
        """Writes the journal anew; where there is no room for that and the file has its name, appends to it.

        A damaged record costs its event, a refused frame costs the frame; the next scrub finds the damage again.
        """
        try:
            await self._renew(events)
        except OSError as error:
            if not no_room(error) or self.misplaced() is not None:
                raise
            self._fault = None
            if events and (fault := await asyncio.to_thread(self._write, events)) is not None:
                self._fault = fault
                raise

    async def _renew(self, events: Sequence[JournalEvent]) -> None:
        """Writes the journal anew: the snapshot, and behind it the events that the snapshot may lack."""
        assert self._snapshot is not None
        assert self._fault is not None
        snapshot = self._snapshot()
        # Events may come twice, except a death, which would be counted twice: its caller applies it afterwards.
        last = [event for event in self._last if not isinstance(event, WorkerDied)]
        self._good = await asyncio.to_thread(self._replace, snapshot, [*last, *events])
        fault, self._fault = self._fault, None
        self._renewed(fault)

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
        """Waits for the write under way; nothing is written later: the descriptor may be another file's by then."""
        self._closed = True
        while self._flushing is not None:
            await asyncio.wait([self._flushing])
        os.close(self._file)


def _index(event: JournalEvent) -> int:
    frames: Sequence[int] = getattr(event, "frames", ())
    return int(getattr(event, "index", frames[0] if frames else 0))
