"""The record of a simulation: frames acknowledged, committed and reported; times of places and of failures got over.

A frame is **run twice** if the service knew of one worker's commit of it (`FrameCommitted` or `Ready` of the scene's
worker, or found by a new service; from then on clients see it), and another worker's commit was reported after it,
or none. Two processes of one scene at a time, neither given up, count as well. A worker is **given up** for the folder
of states once the service has started the next one: until then, what it still commits is taken over and kept.

What a worker commits after the states were linked for the next, and before the link moves, is updated again by design
(docs/cluster.md, Fencing). It was not reported, so it does not count as run twice; it is counted apart.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from studies.simulation.delays import WAIT_S
from studies.simulation.nodes import Capacity


class Hurried(Protocol):
    """The work of a worker that runs."""

    def hurry(self) -> None:
        """Commits now."""


@dataclass(frozen=True)
class FoundFrame:
    """The file of a frame: its content, the worker that wrote it, and the number of that write."""

    state: str
    worker: int
    write: int


@dataclass(frozen=True)
class FrameCounts:
    """Frames found at the end. All but `read` and `again` must be 0.

    Attributes:
        read: through the links. lost: acknowledged, and not read. foreign: read, and written by a worker that was given
            up. different: read, and other bytes than an undisturbed chain has. twice: run twice. beside: processes that
            began while another of their scene ran. again: updated again after a commit that was not reported.
    """

    read: int
    lost: int
    foreign: int
    different: int
    twice: int
    beside: int
    again: int


class FrameRecord:
    """By scene.

    Attributes:
        acknowledged: number of frames, on the service's disk. works: of workers that run, given up or not.
        workers: that were started, each with an epoch of its own.
    """

    def __init__(self) -> None:
        self.acknowledged: dict[str, int] = {}
        self.works: dict[str, dict[Hurried, None]] = {}
        self.workers = 0
        self._newest: dict[str, int] = {}
        self._beside = 0
        self._writes = 0
        self._adrift: set[int] = set()
        self._kept: dict[str, dict[tuple[int, int], None]] = {}
        self._reported: dict[str, dict[int, int]] = {}
        self._twice: dict[str, set[int]] = {}

    def start(self, scene: str, beside: bool) -> int:
        """A worker is started; returns its number. `beside`: another one of the scene has not been given up."""
        self.workers += 1
        self._newest[scene] = self.workers
        self._beside += beside
        return self.workers

    @property
    def adrift(self) -> int:
        """Files that workers wrote after they were given up."""
        return len(self._adrift)

    def write(self, scene: str, worker: int) -> int:
        """A worker writes a file; returns its number, which goes into the file."""
        self._writes += 1
        if worker != self._newest[scene]:
            self._adrift.add(self._writes)
        return self._writes

    def wrote(self, scene: str, index: int, worker: int) -> None:
        """The file of a frame is written."""
        if worker == self._newest[scene]:
            self._kept.setdefault(scene, {})[index, worker] = None

    def report(self, scene: str, index: int, worker: int) -> None:
        """The service learns that a frame is committed."""
        if self._reported.setdefault(scene, {}).setdefault(index, worker) != worker:
            self._twice.setdefault(scene, set()).add(index)

    def untold(self, scene: str, count: int) -> list[int]:
        """Returns those of the first `count` frames, which are committed, that the service did not know of."""
        reported = self._reported.setdefault(scene, {})
        if gone := {index for index in reported if index >= count}:
            self._twice.setdefault(scene, set()).update(gone)
        return [index for index in range(count) if index not in reported]

    def check(self, scene: str, found: dict[int, FoundFrame], chain: Sequence[str]) -> FrameCounts:
        """Checks the frames of a scene that are read at the end.

        Args:
            found: by index. chain: contents of an undisturbed run.
        """
        reported = self._reported.get(scene, {})
        twice = self._twice.get(scene, set()) | {
            index for index, worker in reported.items() if index not in found or found[index].worker != worker
        }
        read = {(index, frame.worker) for index, frame in found.items()}
        again = [(index, worker) for index, worker in self._kept.get(scene, {}) if reported.get(index) != worker]
        return FrameCounts(
            read=len(found),
            lost=sum(index not in found for index in range(self.acknowledged[scene])),
            foreign=sum(frame.write in self._adrift for frame in found.values()),
            different=sum(frame.state != chain[index] for index, frame in found.items()),
            twice=len(twice),
            beside=0,
            again=sum(commit not in read for commit in again),
        )

    def total(self, counts: Sequence[FrameCounts]) -> FrameCounts:
        """Adds scenes up."""
        names = [name for name in FrameCounts.__dataclass_fields__ if name != "beside"]
        return FrameCounts(beside=self._beside, **{name: sum(getattr(one, name) for one in counts) for name in names})


@dataclass
class TimeRecord:
    """By scene.

    Attributes:
        placed: seconds with room until a worker had a place, by the reason for which it was wanted; and those of them
            in which the head answered. resumed: seconds from a failure until the scene went on, by failure; and those
            of them without room. waited: seconds of processes that waited longer than `WAIT_S` for a place.
        unexplained: those of them whose scene was not given a reason.
    """

    capacity: Capacity
    now: Callable[[], float]
    placed: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    resumed: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    waited: list[float] = field(default_factory=list)
    unexplained: int = 0

    def __post_init__(self) -> None:
        self._wanted: dict[str, tuple[str, float, float]] = {}
        self._hit: dict[str, tuple[str, float, float]] = {}
        self._asked: dict[str, float] = {}
        self._explained: set[str] = set()

    @property
    def waiting(self) -> int:
        """Workers that have no place."""
        return len(self._wanted)

    def want(self, scene: str, reason: str, kind: int) -> None:
        """A worker is wanted, unless it was before."""
        self._wanted.setdefault(scene, (reason, *self.capacity.seconds(kind)))

    def ask(self, scene: str) -> None:
        """The service has asked for a place."""
        self._asked[scene] = self.now()
        self._explained.discard(scene)

    def explain(self, scene: str) -> None:
        """The scene was notified that no node has room."""
        self._explained.add(scene)

    def place(self, scene: str, kind: int) -> None:
        """The scene's worker has a place on a node that runs."""
        if (wanted := self._wanted.pop(scene, None)) is None:
            return
        reason, *before = wanted
        room, answered = self.capacity.seconds(kind)
        self.placed.setdefault(reason, []).append((room - before[0], answered - before[1]))
        if (waited := self.now() - self._asked[scene]) > WAIT_S:
            self.waited.append(waited)
            self.unexplained += scene not in self._explained

    def forget(self) -> None:
        """Nobody wants workers: there is no service."""
        self._wanted.clear()

    def drop(self, scene: str) -> None:
        """The scene has ended."""
        self._wanted.pop(scene, None)
        self._hit.pop(scene, None)

    def hit(self, scene: str, failure: str, at: float, kind: int) -> None:
        """A failure has hit the scene, at a moment that may be past; one that it has not got over counts on."""
        without = self.now() - self.capacity.seconds(kind)[0]
        self._hit.setdefault(scene, (failure, at, without))

    def resume(self, scene: str, kind: int) -> None:
        """The scene goes on."""
        if (hit := self._hit.pop(scene, None)) is not None:
            failure, at, before = hit
            without = self.now() - self.capacity.seconds(kind)[0] - before
            self.resumed.setdefault(failure, []).append((self.now() - at, max(0.0, without)))


def left_over(folder: Path) -> int:
    """Folders of epochs, whole or not, that a scene's folder has beside the one that is read."""
    return sum(name.startswith("states.") for name in os.listdir(folder)) - 1
