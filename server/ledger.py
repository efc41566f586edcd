"""What is known of the frames of a scene: the fold of its journal's facts. No disk, no processes, no clock.

The running scene and the one that is found again after a restart go through the same `apply`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from blake3 import blake3

from client.wire import FINISHED, FileKind, FrameReceipt, FrameReportModel, FrameState
from server.facts import (
    Died,
    Fact,
    FramesDeleted,
    Hashes,
    Missing,
    PartTaken,
    Paused,
    SetAside,
    Skipped,
    StatesDeleted,
    Taken,
)

HOPELESS = "the scene has failed at a frame before"
LOST = "the journal's record of this frame is damaged, and so it is not known what was sent"


def frame_identity(hashes: Hashes, time: float) -> str:
    """BLAKE3 over the sorted (camera, kind, BLAKE3 of the file) and the time in seconds."""
    parts = sorted((camera, str(kind), value) for camera, files in hashes.items() for kind, value in files.items())
    return blake3(json.dumps([parts, time]).encode()).hexdigest()


@dataclass
class OpenFrame:
    """A frame whose cameras send one by one."""

    index: int
    time: float | None = None
    hashes: Hashes = field(default_factory=dict)
    files: list[str] = field(default_factory=list)

    @property
    def cameras(self) -> list[str]:
        """Whose picture is here."""
        return sorted(camera for camera, kinds in self.hashes.items() if FileKind.IMAGE in kinds)

    def add(self, part: PartTaken) -> None:
        """One more camera, or one more file of a camera."""
        self.time = part.time if self.time is None else self.time
        self.hashes.setdefault(part.camera, {}).update(part.hashes)
        if part.file not in self.files:
            self.files.append(part.file)


@dataclass
class FrameEntry:
    """What the service knows of a frame that is closed."""

    report: FrameReportModel
    receipt: FrameReceipt | None = None
    files: tuple[str, ...] = ()
    """Its records in the frame log; none once they are deleted."""
    parts: OpenFrame | None = None
    """What it was closed from, while its pictures are held."""
    own_deaths: int = 0
    other_deaths: int = 0

    @property
    def finished(self) -> bool:
        """Nothing more happens to it."""
        return self.report.state in FINISHED


class Ledger:
    """Frames of one scene by index.

    Attributes:
        frames: every index below `next_frame`. open: frames that cameras send one by one. committed: rising indices
            whose state can be read. fatal: why the scene cannot go on, or None.
    """

    def __init__(self, scene: str) -> None:
        self.scene = scene
        self.frames: dict[int, FrameEntry] = {}
        self.open: dict[int, OpenFrame] = {}
        self.committed: list[int] = []
        self.paused = False
        self.fatal: str | None = None
        self.counts = dict.fromkeys(FrameState, 0)
        self.states_deleted = 0

    @property
    def next_frame(self) -> int:
        """The index that is closed next."""
        return len(self.frames)

    @property
    def unfinished(self) -> int:
        """Frames acknowledged and not finished."""
        return self.counts[FrameState.QUEUED] + self.counts[FrameState.UPDATING]

    def apply(self, fact: Fact) -> None:
        """Takes one fact in. Facts may come twice, and those before them may be lost."""
        match fact:
            case Taken():
                self._taken(fact)
            case PartTaken() if fact.index >= self.next_frame:
                self.open.setdefault(fact.index, OpenFrame(fact.index)).add(fact)
            case Missing():
                entry = self._entry(fact.index)
                entry.report.error = fact.reason
                self.move(fact.index, FrameState.MISSING)
            case Skipped():
                for index in fact.frames:
                    self._entry(index).report.error = f"skipped: frame {fact.by} came and the queue was full"
                    self.move(index, FrameState.SKIPPED)
            case SetAside():
                entry = self._entry(fact.index)
                entry.report.error = fact.reason
                entry.report.dropped_cameras = dict(fact.dropped)
                self.fatal = fact.reason if fact.fatal else self.fatal
                self.move(fact.index, FrameState.SET_ASIDE)
            case Died():
                entry = self._entry(fact.index)
                entry.report.attempts += 1
                entry.own_deaths += fact.own
                entry.other_deaths += not fact.own
            case FramesDeleted():
                for index in fact.frames:
                    entry = self._entry(index)
                    entry.files, entry.report.held, entry.parts = (), False, None
            case StatesDeleted():
                for index in fact.frames:
                    self.state_deleted(index)
            case Paused():
                self.paused = fact.paused
            case _:  # created: the scene's own; a part of a frame that is closed
                pass

    def move(self, index: int, state: FrameState) -> None:
        """A frame is in another state."""
        report = self.frames[index].report
        self.counts[report.state] -= 1
        self.counts[state] += 1
        if state == FrameState.COMMITTED and report.state != FrameState.COMMITTED and not report.deleted:
            self.committed.append(index)
            if len(self.committed) > 1 and self.committed[-2] > index:
                self.committed.sort()
        elif state != FrameState.COMMITTED and report.state == FrameState.COMMITTED and index in self.committed:
            self.committed.remove(index)
        report.state = state

    def state_deleted(self, index: int) -> None:
        """The committed state of a frame cannot be read any more."""
        report = self._entry(index).report
        if not report.deleted:
            report.deleted = True
            self.states_deleted += 1
        if index in self.committed:
            self.committed.remove(index)

    def reconcile(self, indices: Sequence[int], damaged: Mapping[int, str]) -> list[Fact]:
        """Brings the frames in line with the committed states that are there, and tells what the journal lacks.

        Args:
            indices: of the states that can be read, rising. damaged: states that cannot, with the reason.

        Returns:
            Facts, already applied, that have to be appended: states that are gone, frames that have to be done again
            and cannot.
        """
        readable, last = set(indices), indices[-1] if indices else -1
        facts: list[Fact] = []
        gone: list[int] = []
        if last >= self.next_frame:  # the journal is damaged
            self._entry(last)
        for index, entry in self.frames.items():
            state = entry.report.state
            if index > last and state == FrameState.COMMITTED:
                entry.report.deleted = False
                self.move(index, FrameState.QUEUED)
                if not entry.files:
                    facts.append(SetAside(index=index, reason="its state is damaged, and its pictures are deleted"))
            elif index <= last and state in (FrameState.QUEUED, FrameState.UPDATING):
                self.move(index, FrameState.COMMITTED)
            elif index in readable and state == FrameState.SET_ASIDE and entry.receipt is None:
                entry.report.error = None  # its fact is lost, its state is not
                self.move(index, FrameState.COMMITTED)
            if entry.report.state == FrameState.COMMITTED and index not in readable and not entry.report.deleted:
                gone.append(index)
        if gone:
            said = "; ".join(damaged[index] for index in gone if index in damaged)
            facts.append(StatesDeleted(frames=tuple(gone), reason=said or "found gone"))
        for fact in facts:
            self.apply(fact)
        return facts

    def waiting(self) -> list[int]:
        """Frames that are queued and not at work, rising. Only the newest can be."""
        found: list[int] = []
        for index in range(self.next_frame - 1, -1, -1):
            if len(found) == self.counts[FrameState.QUEUED]:
                break
            if self.frames[index].report.state == FrameState.QUEUED:
                found.append(index)
        return found[::-1]

    def hopeless(self) -> list[SetAside]:
        """Nothing will become of frames that wait behind a first one that failed: as facts, not applied."""
        if self.fatal is None:
            return []
        return [SetAside(index=index, reason=f"{HOPELESS}: {self.fatal}") for index in self.waiting()]

    def last_time(self) -> float | None:
        """Seconds of the newest closed frame that has a time."""
        for index in range(self.next_frame - 1, -1, -1):
            time = self.frames[index].report.time
            if time is not None:
                return time
        return None

    def _taken(self, fact: Taken) -> None:
        parts = self.open.pop(fact.index, None)
        entry = self._entry(fact.index)
        entry.parts = parts
        entry.receipt = FrameReceipt(scene=self.scene, index=fact.index, time=fact.time, identity=fact.identity)
        entry.files = fact.files
        entry.report.time, entry.report.identity, entry.report.held = fact.time, fact.identity, True
        entry.report.error = None
        self.move(fact.index, FrameState.QUEUED)

    def _entry(self, index: int) -> FrameEntry:
        """The frame's entry; indices that nothing is known of up to it are set aside as lost."""
        for new in range(self.next_frame, index + 1):
            report = FrameReportModel(scene=self.scene, index=new, time=None, state=FrameState.SET_ASIDE, error=LOST)
            self.frames[new] = FrameEntry(report)
            self.counts[FrameState.SET_ASIDE] += 1
            self.open.pop(new, None)
        return self.frames[index]
