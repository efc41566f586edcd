"""The journal of a scene: one append-only file of events. An event is acknowledged when it is on disk.

A file that is deleted, or that another takes the place of, while the service runs would take events that nobody finds
again: each write looks whether the file still has its name. Then, and where a scrub finds it damaged, the journal is
written anew from what the service knows (`snapshot`), beside its place, and renamed.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pydantic import ValidationError

from scas4d_core.storage.npz import sync_folder, written_whole
from server.problems import Problem
from server.storage.disk import no_room
from server.storage.events import JournalEvent, SceneCreated, WorkerDied, parse_event, why_no_event
from server.storage.record_log import Damage, Kind, encoded, streamed

PIECE = 1 << 16
"""Bytes that are compared at a time."""
TOGETHER = 1000
"""Events that are encoded at a time where a whole journal is written."""

Snapshot = Callable[[], Iterator[JournalEvent]]
"""Taken at once, on the event loop; its events may be told in another thread."""


@dataclass(frozen=True)
class JournalRead:
    """What a journal holds: its events in order, the bytes that are whole, and a sentence for each damage."""

    events: list[JournalEvent]
    good: int
    damage: list[str]


def read_journal(path: Path) -> JournalRead:
    """All of a journal that is not large; see `replay`."""
    events: list[JournalEvent] = []
    told = replay(path, events.append)
    return JournalRead(events, told.good, told.damage)


@dataclass(frozen=True)
class JournalReading:
    """How a journal was read: the bytes that are whole, and a sentence for each damage.

    `broken`: more than a torn tail is damaged; what it said may be lost. `begun`: its first event is `SceneCreated`.
    """

    good: int
    damage: list[str]
    broken: bool = False
    begun: bool = False


def replay(path: Path, take: Callable[[JournalEvent], object]) -> JournalReading:
    """Tells `take` every event that is whole, in order, reading piece by piece; never raises for what the file holds.

    A torn tail is what an append leaves that was cut short: it was never acknowledged, and it is dropped.
    """
    said: list[str] = []
    broken = False
    begun: bool | None = None
    try:
        opened = path.open("rb")
    except FileNotFoundError:
        return JournalReading(0, said)
    with opened as file:
        good = os.fstat(file.fileno()).st_size
        for found in streamed(file):
            if isinstance(found, Damage):
                if found.torn:
                    good = found.start
                broken |= not found.torn
                said.append(f"{path.name}: bytes {found.start} to {found.end} dropped: {found.reason}")
                continue
            try:
                event = parse_event(found.text)
            except ValidationError as error:
                fault = why_no_event(error)
                broken = True
                said.append(f"{path.name}: a record of kind {found.kind}, frame {found.frame}, is no event: {fault}")
                continue
            begun = isinstance(event, SceneCreated) if begun is None else begun
            take(event)
    return JournalReading(good, said, broken, bool(begun))


def bytes_of(events: Iterable[JournalEvent]) -> bytes:
    """Events as records, one after the other."""
    return b"".join(encoded(Kind.EVENT, _index(event), event.model_dump(mode="json")) for event in events)


def write_journal(path: Path, events: Iterator[JournalEvent]) -> int:
    """A journal that is whole at `path`, in place of what is there; blocking.

    Returns:
        Its bytes.

    Raises:
        OSError: it could not be written; what was there is there.
    """
    beside = path.with_name(f".{path.name}.part")
    size, batch = 0, []
    with written_whole(path, beside) as file:
        for event in events:
            batch.append(event)
            if len(batch) == TOGETHER:
                size += file.write(bytes_of(batch))
                batch = []
        size += file.write(bytes_of(batch))
    return size


class _Beginning:
    """So many bytes of a file."""

    def __init__(self, file: BinaryIO, left: int) -> None:
        self._file = file
        self._left = left

    def read(self, size: int) -> bytes:
        piece = self._file.read(min(size, self._left))
        self._left -= len(piece)
        return piece


def checked_journal(path: Path, good: int) -> Iterator[int]:
    """Reads the first bytes of a journal again and yields how many, piece by piece.

    Raises:
        FileNotFoundError: it is gone. ValueError: not all of them are whole records.
    """
    read = since = 0
    with path.open("rb") as file:
        for found in streamed(_Beginning(file, good)):
            if isinstance(found, Damage):
                raise ValueError(f"bytes {found.start} to {found.end}: {found.reason}")
            read += found.size
            since += found.size
            if since >= PIECE:
                yield since
                since = 0
    if read != good:
        raise ValueError(f"{read} of {good} bytes are there")
    yield since


class Journal:
    """Appends events. Those that come while one write is under way share the next one.

    Args:
        path: of the file; made where there is none.
        good: bytes of it that are whole; what follows is cut off.
        snapshot: all events that are known now, which the journal is written anew from; None: it never is.
        renewed: told of the fault each time that it was.
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
        """Events that were written last: whoever appended them may not have taken them in yet."""
        self._fault: str | None = None
        self._flushing: asyncio.Task[None] | None = None

    @property
    def place(self) -> tuple[int, int]:
        """Which file it is written to, and the bytes of it that are whole: whether it was written anew meanwhile."""
        return os.fstat(self._file).st_ino, self._good

    async def append(self, *events: JournalEvent) -> None:
        """Returns when the events are on disk, all or none of them.

        Raises:
            OSError: they are not; the file is as it was.
            Problem: 503, the journal is closed.
        """
        if self._closed:
            raise Problem(503, "the scene has ended", remedy="ask again: a scene that was deleted is not found then")
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((events, done))
        self._begin()
        await asyncio.shield(done)

    def renew(self, fault: str) -> None:
        """It was found damaged: it is written anew, in turn with what is appended. `fault`: a sentence."""
        if not self._closed and self._snapshot is not None:
            self._fault = fault
            self._begin()

    def look(self) -> None:
        """Writes it anew where its file has lost its name; while nothing is being written."""
        if self._flushing is None and not self._closed and (fault := self.misplaced()) is not None:
            self.renew(fault)

    def misplaced(self) -> str | None:
        """Whether the file that is written to still has its name and its bytes; a sentence where not."""
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
                except Exception as error:  # whatever it is, those who wait are told
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
                        done.exception()  # whoever asked may have gone: not a fault of the event loop
                if fault is not None and not batch and not self._waiting:
                    break  # the next event tries again
        finally:
            self._flushing = None

    def _write(self, events: Sequence[JournalEvent]) -> str | None:
        """Appends; answers what is wrong with the file's place, and then the events are not where they should be."""
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
        """Writes it anew; where there is no room for that and the file is in its place, what comes goes behind.

        A damaged record costs what it said, a refused frame costs the frame; the next scrub finds the damage again.
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
        """Writes it anew: what the snapshot tells, and behind it what that may lack."""
        assert self._snapshot is not None
        assert self._fault is not None
        told = self._snapshot()
        # Events may be told twice, except a death, which would be counted twice: its sender applies it afterwards.
        last = [event for event in self._last if not isinstance(event, WorkerDied)]
        self._good = await asyncio.to_thread(self._replace, told, [*last, *events])
        fault, self._fault = self._fault, None
        self._renewed(fault)

    def _replace(self, told: Iterator[JournalEvent], behind: Sequence[JournalEvent]) -> int:
        def all_events() -> Iterator[JournalEvent]:
            yield from told
            yield from behind

        size = write_journal(self.path, all_events())
        file = os.open(self.path, os.O_RDWR | os.O_CLOEXEC)
        os.close(self._file)
        self._file = file
        return size

    async def close(self) -> None:
        """Waits for what is being written; nothing is written after that, its number may be another file's by then."""
        self._closed = True
        while self._flushing is not None:
            await asyncio.wait([self._flushing])
        os.close(self._file)


def _index(event: JournalEvent) -> int:
    frames: Sequence[int] = getattr(event, "frames", ())
    return int(getattr(event, "index", frames[0] if frames else 0))
