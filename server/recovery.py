"""A scene found on disk: its journal, its frame log and its states brought together, and what does not fit said."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from client.wire import FrameState
from scas4d_core.history import History, HistoryError
from server.definition import FRAMES_FOLDER, JOURNAL_FILE
from server.facts import Fact, PartTaken, SetAside, Taken
from server.frame_store import FrameDamage, Pictures, frame_of, read_pictures, remove, stored
from server.journal import replay
from server.ledger import Ledger, frame_identity


@dataclass(frozen=True)
class Recovered:
    """A scene as its folder tells it.

    Attributes:
        good: bytes of the journal that are whole. facts: those that the journal lacks, applied already.
        sizes: bytes of each record of the frame log. damage: what was dropped, a sentence each.
    """

    ledger: Ledger
    good: int
    facts: list[Fact]
    sizes: dict[str, int]
    damage: list[str]


def recover(folder: Path, scene: str) -> Recovered:
    """Reads a scene's folder. Removes what interrupted uploads left; appends nothing. Blocking."""
    frames = folder / FRAMES_FOLDER
    frames.mkdir(exist_ok=True)
    ledger = Ledger(scene)
    told = replay(folder / JOURNAL_FILE, ledger.apply)
    damage = list(told.damage)
    sizes = stored(frames)
    facts: list[Fact] = []
    if told.damage:
        facts.extend(_found(frames, sorted(_unnamed(ledger, sizes)), ledger))
    if facts:
        found = ", ".join(dict.fromkeys(str(fact.index) for fact in facts if isinstance(fact, Taken | PartTaken)))
        damage.append(f"the journal does not name the records of frames {found} any more; taken as they were found")
    debris = _unnamed(ledger, sizes)
    remove(frames, debris)
    sizes = {name: size for name, size in sizes.items() if name not in debris}
    indices, damaged, newest = _states(folder / "states", damage)
    facts += ledger.reconcile(indices, damaged)
    if newest:
        ledger.frames.set_numbers(indices[-1], newest)
    for fact in ledger.hopeless():  # its scene failed, and the service ended before it could say so of this one
        ledger.apply(fact)
        facts.append(fact)
    for entry in list(ledger.frames.held()):
        lost = [name for name in entry.files if name not in sizes]
        if lost:
            ledger.frames.set_files(entry.index, tuple(name for name in entry.files if name in sizes))
        if entry.state == FrameState.QUEUED and (reason := _unusable(frames, entry.files, lost)):
            damage.append(f"frame {entry.index}: {reason}")
            gone = SetAside(index=entry.index, reason=reason)
            ledger.apply(gone)
            facts.append(gone)
    return Recovered(ledger, told.good, facts, sizes, damage)


def _unnamed(ledger: Ledger, sizes: dict[str, int]) -> set[str]:
    """Records that no fact names."""
    named = {name for entry in ledger.frames.held() for name in entry.files}
    named |= {name for frame in ledger.open.values() for name in frame.files}
    return set(sizes) - named


def _found(folder: Path, names: list[str], ledger: Ledger) -> Iterator[Taken | PartTaken]:
    """Whole records of frames whose facts the damaged journal has lost, applied.

    Only where one record can be meant: two whole ones of a frame would leave open which was acknowledged.
    """
    for name in names:
        index = frame_of(name)
        entry = ledger.frames.get(index)
        known = entry is not None and (entry.receipt is not None or entry.state != FrameState.SET_ASIDE)
        if known or (entry is None and index != ledger.next_frame):
            continue
        try:
            pictures = read_pictures(folder, name)
        except FrameDamage:
            continue
        fact = _part(index, name, pictures) if pictures.part else _whole(index, name, pictures, ledger)
        alone = pictures.part or sum(frame_of(other) == index for other in names) == 1
        if fact is not None and alone:
            ledger.apply(fact)
            yield fact


def _unusable(folder: Path, files: tuple[str, ...], lost: list[str]) -> str | None:
    """Why a frame that waits cannot be reconstructed. Of several records, one a camera, the worker leaves those out."""
    if lost:
        return f"its record is gone from the frame log: {', '.join(lost)}"
    if len(files) == 1:
        try:
            read_pictures(folder, files[0])
        except FrameDamage as error:
            return f"its record in the frame log is damaged: {error}"
    return None


def _whole(index: int, name: str, pictures: Pictures, ledger: Ledger) -> Taken | None:
    before = max(
        (time for i in range(min(index, ledger.next_frame)) if (time := ledger.frames[i].time) is not None),
        default=None,
    )
    if pictures.time is None or (before is not None and pictures.time <= before):
        return None
    identity = frame_identity(pictures.hashes, pictures.time)
    return Taken(index=index, time=pictures.time, identity=identity, files=(name,), closed_by="found")


def _part(index: int, name: str, pictures: Pictures) -> PartTaken | None:
    if len(pictures.hashes) != 1:
        return None
    ((camera, kinds),) = pictures.hashes.items()
    return PartTaken(index=index, time=pictures.time, camera=camera, file=name, hashes=kinds)


def _states(folder: Path, damage: list[str]) -> tuple[list[int], dict[int, str], dict[str, Any]]:
    """Committed states that can be read, those that cannot, and what was committed with the newest."""
    try:
        history = History.load(folder)
    except HistoryError as error:
        if (folder / "fixed.npz").exists():
            damage.append(f"the committed states cannot be read: {error}")
        return [], {}, {}
    damage.extend(f"frame {index}: its state is damaged: {reason}" for index, reason in history.damaged.items())
    report: dict[str, Any] = {}
    if history.indices:
        with contextlib.suppress(HistoryError):  # the worker takes the state up, or says what is wrong with it
            report = history.report(history.indices[-1])
    return history.indices, dict(history.damaged), report
