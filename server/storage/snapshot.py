"""Conversion of a ledger back to events, from which a damaged or deleted journal is rewritten."""

from __future__ import annotations

from collections.abc import Iterator

from client.wire import Budget, FrameState
from server.storage.events import (
    BudgetChanged,
    CameraAccepted,
    FrameAccepted,
    FrameFailed,
    FrameMissing,
    FramesSkipped,
    JournalEvent,
    OpenFrame,
    PauseChanged,
    PicturesDeleted,
    SceneEdited,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.frame_table import FrameEntry
from server.storage.ledger import Ledger

FRAMES_PER_EVENT = 10_000
"""Maximum number of frames per event, because the head of a record has a limited size."""
OWN_ERROR = (FrameState.FAILED, FrameState.MISSING)
"""States whose frame error explains the state itself.

In other states, the error explains why the committed state no longer exists.
"""
BEFORE_FIRST = "before the journal was rewritten"


def events_of(ledger: Ledger) -> Iterator[JournalEvent]:
    """Yields events that reproduce the ledger, except for the committed states on disk (`Ledger.reconcile`).

    Committed and updating frames become queued frames. The reasons why frames were closed and why workers died are
    lost.
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
            if entry.state not in OWN_ERROR and entry.rare_properties.error is not None:
                yield StatesDeleted(frames=(index,), reason=entry.rare_properties.error)
            else:
                deleted.append(index)
        if not entry.files and (entry.identity is not None or index == count - 1):
            bare.append(index)  # the last frame needs an event so that it exists
    for first in range(0, len(deleted), FRAMES_PER_EVENT):
        yield StatesDeleted(frames=tuple(deleted[first : first + FRAMES_PER_EVENT]))
    for first in range(0, len(bare), FRAMES_PER_EVENT):
        yield PicturesDeleted(frames=tuple(bare[first : first + FRAMES_PER_EVENT]))
    for frame in ledger.open.values():
        yield from _camera_events(frame)
    for first, budget in ledger.budgets:
        if (first, budget) != (0, Budget()):
            yield BudgetChanged(index=first, budget=budget)
    if ledger.paused:
        yield PauseChanged(paused=True)
    if ledger.edited != SceneEdited():
        yield ledger.edited


def _of_frame(entry: FrameEntry, *, fatal: bool) -> Iterator[JournalEvent]:
    index, note, receipt, times = entry.index, entry.rare_properties, entry.receipt, entry.times
    if receipt is not None and times is not None:
        if note.parts is not None:
            yield from _camera_events(note.parts)
        sent = None if times.sent == times.time else times.sent
        yield FrameAccepted(index=index, time=times.time, sent=sent, identity=receipt.identity, files=entry.files)
    elif entry.state == FrameState.COMMITTED or entry.time is not None:
        yield StateFound(index=index, time=entry.time)
    for own in [True] * note.own_deaths + [False] * note.other_deaths:
        yield WorkerDied(index=index, reason=BEFORE_FIRST, own=own)
    match entry.state:
        case FrameState.FAILED if note.error is not None:
            yield FrameFailed(index=index, reason=note.error, dropped=note.dropped, fatal=fatal)
        case FrameState.MISSING:
            yield FrameMissing(index=index, reason=note.error or "")
        case FrameState.SKIPPED:
            yield FramesSkipped(frames=(index,), by=entry.skipped_by)
        case _:
            pass


def _camera_events(frame: OpenFrame) -> Iterator[CameraAccepted]:
    """Yields one event per file.

    The ledger does not record which file belongs to which camera. The files are assigned to the
    cameras in order, so the assignment may be wrong if a camera has several files.
    """
    cameras = list(frame.hashes)
    for place, file in enumerate(frame.files):
        camera = cameras[min(place, len(cameras) - 1)]
        hashes = frame.hashes[camera] if place < len(cameras) else {}
        yield CameraAccepted(index=frame.index, time=frame.time, camera=camera, file=file, hashes=hashes)
