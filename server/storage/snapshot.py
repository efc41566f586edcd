"""Makes events from a ledger: a damaged or deleted journal is written anew with them."""

from __future__ import annotations

from collections.abc import Iterator

from client.wire import Budget, FrameState
from server.storage.events import (
    BudgetChanged,
    FrameAccepted,
    FrameFailed,
    FrameMissing,
    FramesSkipped,
    JournalEvent,
    OpenFrame,
    PartAccepted,
    PauseChanged,
    PicturesDeleted,
    SceneEdited,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.frame_table import FrameEntry
from server.storage.ledger import Ledger

TOGETHER = 10_000
"""An event names at most so many frames: the head of a record is bounded."""
OWN_ERROR = (FrameState.FAILED, FrameState.MISSING)
"""The error noted of a frame in such a state explains the state; of another frame, why its committed state is gone."""
BEFORE = "before the journal was written anew"


def events_of(ledger: Ledger) -> Iterator[JournalEvent]:
    """Yields events in an order that gives an equal ledger, but for the states on disk (`Ledger.reconcile`).

    A frame that is committed or at work is queued in it. The ways that frames were closed, and the reasons of deaths,
    are not kept.
    """
    if ledger.begun is not None:
        yield ledger.begun
    bare: list[int] = []
    deleted: list[int] = []
    count = len(ledger.frames)
    for index in range(count):
        entry = ledger.frames[index]
        yield from _of_frame(entry, fatal=index == ledger.failed_at)
        if entry.deleted:
            if entry.state not in OWN_ERROR and entry.note.error is not None:
                yield StatesDeleted(frames=(index,), reason=entry.note.error)
            else:
                deleted.append(index)
        if not entry.files and (entry.identity is not None or index == count - 1):
            bare.append(index)  # of the last one, that it is there
    for first in range(0, len(deleted), TOGETHER):
        yield StatesDeleted(frames=tuple(deleted[first : first + TOGETHER]))
    for first in range(0, len(bare), TOGETHER):
        yield PicturesDeleted(frames=tuple(bare[first : first + TOGETHER]))
    for frame in ledger.open.values():
        yield from _parts(frame)
    for first, budget in ledger.budgets:
        if (first, budget) != (0, Budget()):
            yield BudgetChanged(index=first, budget=budget)
    if ledger.paused:
        yield PauseChanged(paused=True)
    if ledger.edited != SceneEdited():
        yield ledger.edited


def _of_frame(entry: FrameEntry, *, fatal: bool) -> Iterator[JournalEvent]:
    index, note, receipt = entry.index, entry.note, entry.receipt
    if receipt is not None:
        if note.parts is not None:
            yield from _parts(note.parts)
        yield FrameAccepted(index=index, time=receipt.time, identity=receipt.identity, files=entry.files)
    elif entry.state == FrameState.COMMITTED or entry.time is not None:
        yield StateFound(index=index, time=entry.time)
    for own in [True] * note.own_deaths + [False] * note.other_deaths:
        yield WorkerDied(index=index, reason=BEFORE, own=own)
    match entry.state:
        case FrameState.FAILED if note.error is not None:
            yield FrameFailed(index=index, reason=note.error, dropped=note.dropped, fatal=fatal)
        case FrameState.MISSING:
            yield FrameMissing(index=index, reason=note.error or "")
        case FrameState.SKIPPED:
            yield FramesSkipped(frames=(index,), by=entry.skipped_by)
        case _:
            pass


def _parts(frame: OpenFrame) -> Iterator[PartAccepted]:
    """Yields an event a file; a camera may have sent several, and their order is not kept."""
    cameras = list(frame.hashes)
    for place, file in enumerate(frame.files):
        camera = cameras[min(place, len(cameras) - 1)]
        hashes = frame.hashes[camera] if place < len(cameras) else {}
        yield PartAccepted(index=frame.index, time=frame.time, camera=camera, file=file, hashes=hashes)
