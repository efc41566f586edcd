"""Recovers a scene from its folder: brings journal, frame log and states together, and names what does not fit."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from client.wire import FileKind, FrameState
from scas4d_core.storage.faults import OtherFormatError
from scas4d_core.storage.frame_files import FrameFiles
from scas4d_core.storage.history import History, HistoryError
from server.storage.definition import DefinitionError, begun_of
from server.storage.disk import no_room
from server.storage.events import (
    FrameAccepted,
    FrameFailed,
    Hashes,
    JournalEvent,
    PartAccepted,
    SceneCreated,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.fencing import heal
from server.storage.frame_store import FrameDamage, StoredPictures, frame_of, read_pictures, remove, stored
from server.storage.journal import replay, write_journal
from server.storage.layout import SceneFolder
from server.storage.ledger import Ledger, frame_identity
from server.storage.snapshot import events_of

OF_STATES = (FrameFailed, StateFound, StatesDeleted, WorkerDied)
"""Events of one reconstruction: another one tries the frame again, and has other states."""
NO_STATE = "the journal was lost, and there is no committed state of this frame"


@dataclass(frozen=True)
class Recovered:
    """A scene as found in its folder.

    Attributes:
        folder: with the names of the reconstruction that was begun last.
        good: bytes of the journal that are whole. events: those that the journal lacks, applied already.
        sizes: bytes of each record of the frame log. damage: a sentence for each thing that was dropped.
        recompute: frames whose states are damaged or gone, with the reason, and whose pictures are held.
        first_report: of the first committed frame that can be read; empty where there is none.
    """

    folder: SceneFolder
    ledger: Ledger
    good: int
    events: list[JournalEvent]
    sizes: dict[str, int]
    damage: list[str]
    recompute: dict[int, str] = field(default_factory=dict)
    first_report: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _States:
    """Committed states: times of those that can be read, faults of the others, reports of the newest and the first."""

    times: dict[int, float] = field(default_factory=dict)
    damaged: dict[int, str] = field(default_factory=dict)
    newest: dict[str, Any] = field(default_factory=dict)
    first: dict[str, Any] = field(default_factory=dict)

    @property
    def indices(self) -> list[int]:
        return list(self.times)

    @property
    def last(self) -> int:
        return max(self.times, default=-1)


def recover(folder: SceneFolder, scene: str, definition: Mapping[str, Any] | None = None) -> Recovered:
    """Reads a scene's folder and removes what interrupted uploads left. Blocking.

    A journal that is damaged or gone loses its own content and nothing else: committed states and whole records of
    pictures are found again, nothing is removed, and a new journal is written with all that is known.

    Args:
        folder: of the scene. scene: its id. definition: as in `SceneCreated`; without it no new journal is written.
    """
    frames, journal = folder.frames, folder.journal
    frames.mkdir(exist_ok=True)
    ledger = Ledger(scene)
    reading = replay(journal, ledger.apply)
    damage = list(reading.damage)
    if not reading.begun:  # a scene is made with its journal, which begins with that
        damage.append(f"{journal.name} {'lacks its beginning' if journal.exists() else 'is gone'}")
    broken = reading.broken or not reading.begun
    begun = begun_of(definition or {})
    if begun is not None and begun.number > ledger.reconstruction:
        # It is not known which events came before it: those of states may be of other states.
        damage.append(f"{journal.name} does not have the beginning of reconstruction {begun.number} any more")
        broken, ledger = True, Ledger(scene)
        ledger.apply(begun)
        replay(journal, lambda event: None if isinstance(event, OF_STATES) else ledger.apply(event))
    folder = folder.begun(ledger.begun)
    sizes = stored(frames)
    in_states: list[str] = []
    heal(folder.states)
    states = _states(folder.states, in_states)
    events: list[JournalEvent] = []
    if broken:
        events.extend(_found_states(states, ledger))
    if damage:
        events.extend(_found(frames, sorted(_unnamed(ledger, sizes)), ledger, states, broken))
    if recovered_frames := sorted({event.index for event in events if isinstance(event, FrameAccepted | PartAccepted)}):
        listed = ", ".join(map(str, recovered_frames))
        damage.append(f"the journal does not name the records of frames {listed} any more; used as they were found")
    damage += in_states
    debris = _unnamed(ledger, sizes)
    if broken and debris:
        damage.append(f"{len(debris)} records of pictures belong to nothing that is known; left until the next start")
    elif debris:
        remove(frames, debris)
    sizes = {name: size for name, size in sizes.items() if name not in debris}
    recompute = _remade(ledger, states, broken, _deletes_states(definition or {}, ledger))
    damage.extend(f"frame {index}: {reason}" for index, reason in recompute.items() if index not in states.damaged)
    events += ledger.reconcile(states.indices, states.damaged, recompute)
    if states.newest:
        ledger.frames.set_record(states.last, states.newest)
    for event in ledger.hopeless():  # its scene failed, and the service ended before it could say so of this one
        ledger.apply(event)
        events.append(event)
    for entry in list(ledger.frames.with_pictures()):
        lost = [name for name in entry.files if name not in sizes]
        if lost:
            ledger.frames.set_files(entry.index, tuple(name for name in entry.files if name in sizes))
            if entry.state == FrameState.COMMITTED:
                damage.append(f"frame {entry.index}: its record is gone from the frame log: {', '.join(lost)}")
        if entry.state == FrameState.QUEUED and (reason := _unusable(frames, entry.files, lost)):
            damage.append(f"frame {entry.index}: {reason}")
            gone = FrameFailed(index=entry.index, reason=reason)
            ledger.apply(gone)
            events.append(gone)
    good = reading.good
    if broken and definition is not None:
        try:
            known = SceneCreated(definition=dict(definition))
            good = write_journal(journal, iter((known, *events_of(ledger))))
            events = []
            damage.append(f"{journal.name} was written anew from what is known")
        except OSError as error:
            if not no_room(error):
                raise
    return Recovered(folder, ledger, good, events, sizes, damage, recompute, states.first)


def _unnamed(ledger: Ledger, sizes: dict[str, int]) -> set[str]:
    """Returns the records that no event names."""
    named = {name for entry in ledger.frames.with_pictures() for name in entry.files}
    named |= {name for frame in ledger.open.values() for name in frame.files}
    return set(sizes) - named


def _deletes_states(definition: Mapping[str, Any], ledger: Ledger) -> bool:
    """True for a scene with a rule that deletes old states."""
    if ledger.edited.keep_states is not None:
        return any(value is not None for _, value in ledger.edited.keep_states)
    if not definition:  # of a new scene
        return False
    return any(value is not None for value in definition["request"]["ingest"]["keep_states"].values())


def _remade(ledger: Ledger, states: _States, broken: bool, deletes: bool) -> dict[int, str]:
    """Finds frames whose committed states cannot be read and can be made again, because their pictures are held.

    Where events are lost, a frame without a state may never have been committed. Where a rule deletes old states,
    those before the oldest (but the first, which stays) are not missed: the journal may not have heard of it.
    """
    oldest = min(sorted(states.times)[1:], default=0) if deletes else 0
    return {
        entry.index: states.damaged.get(entry.index, "its state is gone from the disk")
        for entry in ledger.frames.with_pictures()
        if entry.state in (FrameState.QUEUED, FrameState.COMMITTED)
        and entry.index < states.last
        and entry.index not in states.times
        and not entry.deleted
        and (entry.index in states.damaged or (not broken and entry.index >= oldest))
    }


def _found_states(states: _States, ledger: Ledger) -> Iterator[StateFound]:
    """Yields committed states whose events the damaged journal has lost, as events, applied."""
    for index, time in states.times.items():
        entry = ledger.frames.get(index)
        if entry is None or (entry.receipt is None and entry.time is None):
            event = StateFound(index=index, time=time)
            ledger.apply(event)
            yield event


def _found(folder: Path, names: list[str], ledger: Ledger, states: _States, broken: bool) -> Iterator[JournalEvent]:
    """Yields whole records of frames whose events the damaged journal has lost, as events, applied.

    Only one whole record of a frame is accepted: of two it is not known which was acknowledged.
    """
    by_frame: defaultdict[int, list[str]] = defaultdict(list)
    for name in names:
        by_frame[frame_of(name)].append(name)
    for index, records in by_frame.items():
        entry = ledger.frames.get(index)
        without = entry is not None and entry.receipt is None
        known = entry is not None and not (without and entry.state in (FrameState.FAILED, FrameState.COMMITTED))
        if known or (entry is None and index != ledger.next_frame and not broken):
            continue
        for event in _events_of(folder, index, records, ledger, states):
            ledger.apply(event)
            yield event


def _events_of(folder: Path, index: int, names: list[str], ledger: Ledger, states: _States) -> list[JournalEvent]:
    """Makes the events of one frame from its records."""
    pictures: dict[str, StoredPictures] = {}
    for name in names:
        with contextlib.suppress(FrameDamage):
            pictures[name] = read_pictures(folder, name)
    whole = [name for name, events in pictures.items() if not events.part]
    parts = {name: events for name, events in pictures.items() if events.part}
    if len(names) == len(whole) == 1:
        accepted = _whole(index, whole[0], pictures[whole[0]], ledger)
    elif index < ledger.next_frame:
        accepted = _closed(index, parts, states.times.get(index))
    else:
        events = [_part(index, name, pictures) for name, pictures in parts.items()]
        return [event for event in events if event is not None]
    if accepted is None:
        return []
    known = index in states.times or index in states.damaged
    if ledger.frames.first <= index < states.last and not known:
        return [accepted, FrameFailed(index=index, reason=NO_STATE)]
    return [accepted]


def _unusable(folder: Path, files: tuple[str, ...], lost: list[str]) -> str | None:
    """Says why a queued frame cannot be reconstructed, or None. The worker drops damaged ones of several records."""
    if lost:
        return f"its record is gone from the frame log: {', '.join(lost)}"
    if len(files) == 1:
        try:
            read_pictures(folder, files[0])
        except FrameDamage as error:
            return f"its record in the frame log is damaged: {error}"
    return None


def _whole(index: int, name: str, pictures: StoredPictures, ledger: Ledger) -> FrameAccepted | None:
    before = max(
        (time for i in range(min(index, ledger.next_frame)) if (time := ledger.frames[i].time) is not None),
        default=None,
    )
    if pictures.time is None or (before is not None and pictures.time <= before):
        return None
    identity = frame_identity(pictures.hashes, pictures.time)
    return FrameAccepted(index=index, time=pictures.time, identity=identity, files=(name,), closed_by="found")


def _closed(index: int, parts: Mapping[str, StoredPictures], time: float | None) -> FrameAccepted | None:
    """Makes the event of a committed frame that its cameras sent one by one."""
    hashes: Hashes = {}
    for pictures in parts.values():
        for camera, kinds in pictures.hashes.items():
            hashes.setdefault(camera, {}).update(kinds)
    hashes = {camera: kinds for camera, kinds in hashes.items() if FileKind.IMAGE in kinds}
    if time is None or not hashes:
        return None
    files = tuple(sorted(parts))
    return FrameAccepted(index=index, time=time, identity=frame_identity(hashes, time), files=files, closed_by="found")


def _part(index: int, name: str, pictures: StoredPictures) -> PartAccepted | None:
    if len(pictures.hashes) != 1:
        return None
    ((camera, kinds),) = pictures.hashes.items()
    return PartAccepted(index=index, time=pictures.time, camera=camera, file=name, hashes=kinds)


def _states(folder: Path, damage: list[str]) -> _States:
    """Reads the committed states of the folder; what is wrong with them is added to `damage`."""
    try:
        history = History.load(folder)
    except OtherFormatError as error:  # not damage: the folder stays as it is
        raise DefinitionError(str(error)) from None
    except HistoryError as error:
        if folder.exists() and FrameFiles(folder).list_stamps():
            damage.append(f"the committed states cannot be read: {error}")
        return _States()
    damage.extend(f"frame {index}: its state is damaged: {reason}" for index, reason in history.damaged.items())
    damage.extend(history.damaged_chunks)
    newest: dict[str, Any] = {}
    if history.indices:
        with contextlib.suppress(HistoryError):  # the worker loads the state, or says why it cannot
            newest = history.report(history.indices[-1])
    times = dict(zip(history.indices, history.times.tolist(), strict=True))
    return _States(times, dict(history.damaged), newest, history.first_report)
