"""Recovery of a scene from its folder: reconciles the journal, frame log and states, and reports inconsistencies."""

from __future__ import annotations

import contextlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from client.wire import FileKind, FrameState, SceneCreate
from scas4d_core.storage.faults import OtherFormatError
from scas4d_core.storage.frame_files import FrameFiles
from scas4d_core.storage.history import History, HistoryError
from server.storage.definition import DefinitionError, reconstruction_of
from server.storage.disk import no_room
from server.storage.events import (
    CameraAccepted,
    FrameAccepted,
    FrameFailed,
    Hashes,
    JournalEvent,
    SceneCreated,
    StateFound,
    StatesDeleted,
    WorkerDied,
)
from server.storage.fencing import repair_link
from server.storage.frame_store import FrameDamage, StoredPictures, frame_of, list_records, read_pictures, remove
from server.storage.journal import replay, write_journal
from server.storage.layout import SceneFolder
from server.storage.ledger import Ledger, frame_identity
from server.storage.snapshot import events_of

RECONSTRUCTION_EVENTS = (FrameFailed, StateFound, StatesDeleted, WorkerDied)
"""Event types that apply to one reconstruction only; a restarted one retries the frames and has new states."""
NO_STATE = "the journal was lost, and this frame has no committed state"


@dataclass(frozen=True)
class Recovered:
    """Scene as recovered from its folder.

    Attributes:
        folder: scene folder with the file names of the latest reconstruction.
        ledger: the scene's ledger with all `events` applied.
        good: size of the journal in bytes, without a torn tail.
        events: events that the journal lacks and that have been applied to the ledger.
        sizes: size in bytes of each record in the frame log, keyed by record name.
        damage: one sentence per fault that was found.
        recompute: maps each frame whose state is damaged or missing, but whose images are stored, to the reason.
        first_report: report of the first readable committed frame; empty if there is none.
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
    """Committed states: times of readable states, faults of damaged states, and the newest and first reports."""

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
    """Reads a scene's folder and removes leftovers of interrupted uploads. Blocks.

    If the journal is damaged or missing, only its own content is lost. Committed states and complete image records are
    rediscovered, nothing is removed, and the journal is rewritten from the recovered ledger.

    Args:
        folder: scene folder.
        scene: scene ID.
        definition: definition as in `SceneCreated`; if None, the journal is not rewritten.

    Raises:
        DefinitionError: the committed states have an unsupported format.
    """
    frames, journal = folder.frames, folder.journal
    frames.mkdir(exist_ok=True)
    ledger = Ledger(scene)
    reading = replay(journal, ledger.apply)
    damage = list(reading.damage)
    if not reading.begun:  # the journal is created with the scene and starts with `SceneCreated`
        damage.append(f"{journal.name} {'lacks its first event' if journal.exists() else 'is missing'}")
    broken = reading.broken or not reading.begun
    begun = reconstruction_of(definition or {})
    if begun is not None and begun.number > ledger.reconstruction:
        # The order relative to the restart is unknown, so events of states may belong to an earlier reconstruction.
        damage.append(f"{journal.name} no longer contains the start of reconstruction {begun.number}")
        broken, ledger = True, Ledger(scene)
        ledger.apply(begun)
        replay(journal, lambda event: None if isinstance(event, RECONSTRUCTION_EVENTS) else ledger.apply(event))
    folder = folder.of_reconstruction(ledger.begun)
    sizes = list_records(frames)
    in_states: list[str] = []
    repair_link(folder.states)
    states = _states(folder.states, in_states)
    events: list[JournalEvent] = []
    if broken:
        events.extend(_events_of_states(states, ledger))
    if damage:
        names, fps = sorted(_unreferenced(ledger, sizes)), _frame_rate(definition or {})
        events.extend(_events_of_records(frames, names, ledger, states, broken, fps))
    if recovered_frames := sorted(
        {event.index for event in events if isinstance(event, FrameAccepted | CameraAccepted)}
    ):
        listed = ", ".join(map(str, recovered_frames))
        damage.append(f"the journal no longer lists the records of frames {listed}; they were used as found")
    damage += in_states
    debris = _unreferenced(ledger, sizes)
    if broken and debris:
        damage.append(f"{len(debris)} image records belong to no known frame; they are kept until the next start")
    elif debris:
        remove(frames, debris)
    sizes = {name: size for name, size in sizes.items() if name not in debris}
    recompute = _recomputable(ledger, states, broken, _deletes_states(definition or {}, ledger))
    damage.extend(f"frame {index}: {reason}" for index, reason in recompute.items() if index not in states.damaged)
    events += ledger.reconcile(states.indices, states.damaged, recompute)
    if states.newest:
        ledger.frames.set_record(states.last, states.newest)
    for event in (
        ledger.failures_of_waiting_frames()
    ):  # the service stopped after the scene failed, before it could fail this frame
        ledger.apply(event)
        events.append(event)
    for entry in list(ledger.frames.with_pictures()):
        lost = [name for name in entry.files if name not in sizes]
        if lost:
            ledger.frames.set_files(entry.index, tuple(name for name in entry.files if name in sizes))
            if entry.state == FrameState.COMMITTED:
                damage.append(f"frame {entry.index}: its record is missing from the frame log: {', '.join(lost)}")
        if entry.state == FrameState.QUEUED and (reason := _fault_of(frames, entry.files, lost)):
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
            damage.append(f"{journal.name} was rewritten from the recovered data")
        except OSError as error:
            if not no_room(error):
                raise
    return Recovered(folder, ledger, good, events, sizes, damage, recompute, states.first)


def _unreferenced(ledger: Ledger, sizes: dict[str, int]) -> set[str]:
    """Returns the names of the records that no event references."""
    named = {name for entry in ledger.frames.with_pictures() for name in entry.files}
    named |= {name for frame in ledger.open.values() for name in frame.files}
    return set(sizes) - named


def _frame_rate(definition: Mapping[str, Any]) -> float:
    """Returns the frame rate in the scene's definition."""
    default: float = SceneCreate.model_fields["frames_per_second"].default
    return float(definition["request"]["frames_per_second"]) if definition else default


def _deletes_states(definition: Mapping[str, Any], ledger: Ledger) -> bool:
    """Returns whether the scene has a retention rule that deletes old states."""
    if ledger.edited.keep_states is not None:
        return any(value is not None for _, value in ledger.edited.keep_states)
    if not definition:  # a new scene
        return False
    return any(value is not None for value in definition["request"]["ingest"]["keep_states"].values())


def _recomputable(ledger: Ledger, states: _States, broken: bool, deletes: bool) -> dict[int, str]:
    """Returns the frames whose unreadable states can be recomputed from their stored images.

    The result maps each of these frames to the reason why its state is unreadable.

    If events are lost, a frame without a state may never have been committed, so it is not included. If a rule deletes
    old states, missing states before the oldest one are ignored, because the journal may lack their deletion. The first
    state is exempt from deletion and does not count as the oldest.
    """
    oldest = min(sorted(states.times)[1:], default=0) if deletes else 0
    return {
        entry.index: states.damaged.get(entry.index, "its state is missing from the disk")
        for entry in ledger.frames.with_pictures()
        if entry.state in (FrameState.QUEUED, FrameState.COMMITTED)
        and entry.index < states.last
        and entry.index not in states.times
        and not entry.deleted
        and (entry.index in states.damaged or (not broken and entry.index >= oldest))
    }


def _events_of_states(states: _States, ledger: Ledger) -> Iterator[StateFound]:
    """Yields and applies events for committed states whose events the damaged journal has lost."""
    for index, time in states.times.items():
        entry = ledger.frames.get(index)
        if entry is None or (entry.receipt is None and entry.time is None):
            event = StateFound(index=index, time=time)
            ledger.apply(event)
            yield event


def _events_of_records(
    folder: Path, names: list[str], ledger: Ledger, states: _States, broken: bool, fps: float
) -> Iterator[JournalEvent]:
    """Yields and applies events for image records whose events the damaged journal has lost.

    A frame with two or more complete records is not recovered, because it is unknown which one was acknowledged.
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
        for event in _events_of(folder, index, records, ledger, states, fps):
            ledger.apply(event)
            yield event


def _events_of(
    folder: Path, index: int, names: list[str], ledger: Ledger, states: _States, fps: float
) -> list[JournalEvent]:
    """Returns the events of one frame, derived from its records."""
    pictures: dict[str, StoredPictures] = {}
    for name in names:
        with contextlib.suppress(FrameDamage):
            pictures[name] = read_pictures(folder, name)
    whole = [name for name, events in pictures.items() if not events.part]
    parts = {name: events for name, events in pictures.items() if events.part}
    if len(names) == len(whole) == 1:
        accepted = _frame_event(index, whole[0], pictures[whole[0]], ledger, states.times.get(index), fps)
    elif index < ledger.next_frame:
        accepted = _close_event(index, parts, states.times.get(index))
    else:
        events = [_camera_event(index, name, pictures) for name, pictures in parts.items()]
        return [event for event in events if event is not None]
    if accepted is None:
        return []
    known = index in states.times or index in states.damaged
    if ledger.frames.first <= index < states.last and not known:
        return [accepted, FrameFailed(index=index, reason=NO_STATE)]
    return [accepted]


def _fault_of(folder: Path, files: tuple[str, ...], lost: list[str]) -> str | None:
    """Returns the reason why a queued frame cannot be reconstructed, or None.

    If the frame has several records, the worker itself drops damaged ones.
    """
    if lost:
        return f"its record is missing from the frame log: {', '.join(lost)}"
    if len(files) == 1:
        try:
            read_pictures(folder, files[0])
        except FrameDamage as error:
            return f"its record in the frame log is damaged: {error}"
    return None


def _frame_event(
    index: int, name: str, pictures: StoredPictures, ledger: Ledger, time: float | None, fps: float
) -> FrameAccepted | None:
    """Returns the event of a frame that was uploaded as a whole; `time` is that of its committed state, if any."""
    if pictures.time is None:
        return None
    return ledger.accepted_event(index, pictures.time, pictures.hashes, (name,), fps, "found", time=time)


def _close_event(index: int, parts: Mapping[str, StoredPictures], time: float | None) -> FrameAccepted | None:
    """Returns the event that closes a frame whose cameras uploaded separately.

    Returns None if the time of the frame is unknown or no record contains an image.
    """
    hashes: Hashes = {}
    for pictures in parts.values():
        for camera, kinds in pictures.hashes.items():
            hashes.setdefault(camera, {}).update(kinds)
    hashes = {camera: kinds for camera, kinds in hashes.items() if FileKind.IMAGE in kinds}
    if time is None or not hashes:
        return None
    files = tuple(sorted(parts))
    return FrameAccepted(index=index, time=time, identity=frame_identity(hashes, time), files=files, closed_by="found")


def _camera_event(index: int, name: str, pictures: StoredPictures) -> CameraAccepted | None:
    if len(pictures.hashes) != 1:
        return None
    ((camera, kinds),) = pictures.hashes.items()
    return CameraAccepted(index=index, time=pictures.time, camera=camera, file=name, hashes=kinds)


def _states(folder: Path, damage: list[str]) -> _States:
    """Reads the committed states of the folder and appends their faults to `damage`."""
    try:
        history = History.load(folder)
    except OtherFormatError as error:  # not damage: leave the folder unchanged
        raise DefinitionError(str(error)) from None
    except HistoryError as error:
        if folder.exists() and FrameFiles(folder).list_stamps():
            damage.append(f"the committed states cannot be read: {error}")
        return _States()
    damage.extend(f"frame {index}: its state is damaged: {reason}" for index, reason in history.damaged.items())
    damage.extend(history.damaged_chunks)
    newest: dict[str, Any] = {}
    if history.indices:
        with contextlib.suppress(HistoryError):  # the worker loads the state or reports why it cannot
            newest = history.report(history.indices[-1])
    times = dict(zip(history.indices, history.times.tolist(), strict=True))
    return _States(times, dict(history.damaged), newest, history.first_report)
