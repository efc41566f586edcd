"""Journals and logs of records, read whole into memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from server.storage.events import JournalEvent
from server.storage.journal import replay
from server.storage.record_log import Damage, LogRecord, read_at


@dataclass(frozen=True)
class JournalContent:
    """Intact events of a journal in order, its size without a torn tail, and one sentence per damaged region."""

    events: list[JournalEvent]
    good: int
    damage: list[str]


def read_journal(path: Path) -> JournalContent:
    """Reads a complete journal into memory."""
    events: list[JournalEvent] = []
    reading = replay(path, events.append)
    return JournalContent(events, reading.good, reading.damage)


def read_records(data: bytes) -> Iterator[LogRecord | Damage]:
    """Yields every intact record of a log, and the damage between records, in order."""
    at = 0
    while at < len(data):
        record, at = read_at(data, at)
        yield record
