"""The journal of a scene: one append-only file of facts. A fact is acknowledged when it is on disk."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from scas4d_core.npz import sync_folder
from server.facts import Fact, no_fact, parse_fact
from server.problems import Problem
from server.record_log import Damage, Kind, encoded, streamed


@dataclass(frozen=True)
class JournalRead:
    """What a journal holds: its facts in order, the bytes that are whole, and a sentence for each damage."""

    facts: list[Fact]
    good: int
    damage: list[str]


def read_journal(path: Path) -> JournalRead:
    """All of a journal that is not large; see `replay`."""
    facts: list[Fact] = []
    told = replay(path, facts.append)
    return JournalRead(facts, told.good, told.damage)


@dataclass(frozen=True)
class Replayed:
    """How a journal was read: the bytes that are whole, and a sentence for each damage."""

    good: int
    damage: list[str]


def replay(path: Path, take: Callable[[Fact], object]) -> Replayed:
    """Tells `take` every fact that is whole, in order, reading piece by piece; never raises for what the file holds.

    A torn tail is what an append leaves that was cut short: it was never acknowledged, and it is dropped.
    """
    said: list[str] = []
    if not path.exists():
        return Replayed(0, said)
    with path.open("rb") as file:
        good = os.fstat(file.fileno()).st_size
        for found in streamed(file):
            if isinstance(found, Damage):
                if found.torn:
                    good = found.start
                said.append(f"{path.name}: bytes {found.start} to {found.end} dropped: {found.reason}")
                continue
            try:
                take(parse_fact(found.text))
            except ValidationError as error:
                fault = no_fact(error)
                said.append(f"{path.name}: a record of kind {found.kind}, frame {found.frame}, is no fact: {fault}")
    return Replayed(good, said)


class Journal:
    """Appends facts. Those that come while one write is under way share the next one.

    Args:
        path: of the file; made where there is none.
        good: bytes of it that are whole; what follows is cut off.
    """

    def __init__(self, path: Path, good: int = 0) -> None:
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        self._good = good
        self._closed = False
        os.ftruncate(self._file, good)
        os.fsync(self._file)
        sync_folder(path.parent)
        self._waiting: list[tuple[bytes, asyncio.Future[None]]] = []
        self._flushing: asyncio.Task[None] | None = None

    async def append(self, *facts: Fact) -> None:
        """Returns when the facts are on disk, all or none of them.

        Raises:
            OSError: they are not; the file is as it was.
            Problem: 503, the journal is closed.
        """
        if self._closed:
            raise Problem(503, "the scene has ended", remedy="ask again: a scene that was deleted is not found then")
        data = b"".join(encoded(Kind.FACT, _index(fact), fact.model_dump(mode="json")) for fact in facts)
        done: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiting.append((data, done))
        if self._flushing is None:
            self._flushing = asyncio.create_task(self._flush())
        await asyncio.shield(done)

    async def _flush(self) -> None:
        try:
            while self._waiting:
                batch, self._waiting = self._waiting, []
                fault: OSError | None = None
                try:
                    await asyncio.to_thread(self._write, b"".join(data for data, _ in batch))
                except OSError as error:
                    fault = error
                for _, done in batch:
                    if done.done():
                        continue
                    if fault is None:
                        done.set_result(None)
                    else:
                        done.set_exception(fault)
                        done.exception()  # whoever asked may have gone: not a fault of the event loop
        finally:
            self._flushing = None

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[os.pwrite(self._file, view, self._good + len(data) - len(view)) :]
            os.fsync(self._file)
        except OSError:
            os.ftruncate(self._file, self._good)  # half a record must not stand before a whole one
            raise
        self._good += len(data)

    async def close(self) -> None:
        """Waits for what is being written; nothing is written after that, its number may be another file's by then."""
        self._closed = True
        while self._flushing is not None:
            await asyncio.wait([self._flushing])
        os.close(self._file)


def _index(fact: Fact) -> int:
    frames: Sequence[int] = getattr(fact, "frames", ())
    return int(getattr(fact, "index", frames[0] if frames else 0))
