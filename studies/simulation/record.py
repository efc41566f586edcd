"""Record of a simulation: acknowledged, committed and reported frames, and times of placement and recovery.

A frame is **run twice** if, after one worker's commit was reported to the service, another worker's commit is reported
or no commit is left. A commit is reported by `FrameCommitted` or `Ready` of the scene's worker, or when a new service
finds it. From then on, clients see it. Two processes of one scene that run at the same time are also counted, unless
one was given up. A worker is **given up** for the folder of states once the service has started the next worker. Until
then, its commits are taken over and kept.

By design, some frames are updated again: those that a worker commits after the states were linked for the next worker,
but before the link moves (docs/cluster.md, Fencing). Such frames were not reported, so they are counted separately and
do not count as run twice.
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
    """Protocol of a running worker's work."""

    def hurry(self) -> None:
        """Commits the next frame immediately."""


@dataclass(frozen=True)
class FoundFrame:
    """Contents of a frame's file.

    Attributes:
        state: state of the frame.
        worker: number of the worker that wrote the file.
        write: number of the write.
    """

    state: str
    worker: int
    write: int


@dataclass(frozen=True)
class FrameCounts:
    """Frame counts at the end of the run. All except `read` and `again` must be 0.

    Attributes:
        read: frames read through the links.
        lost: acknowledged frames that were not read.
        foreign: frames that were read but written by a worker that was given up.
        different: frames that were read but differ from those of an undisturbed chain.
        twice: frames that were run twice.
        beside: processes that started while another process of the same scene was running.
        again: frames that were updated again after a commit that was not reported.
    """

    read: int
    lost: int
    foreign: int
    different: int
    twice: int
    beside: int
    again: int


class FrameRecord:
    """Record of all scenes' frames.

    Attributes:
        acknowledged: number of acknowledged frames on the service's disk, keyed by scene.
        works: work of running workers, given up or not, keyed by scene.
        workers: number of workers started, each with its own epoch.
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
        """Registers a started worker and returns its number.

        Args:
            scene: scene id.
            beside: whether another process of the scene is active.
        """
        self.workers += 1
        self._newest[scene] = self.workers
        self._beside += beside
        return self.workers

    @property
    def adrift(self) -> int:
        """Number of files that workers wrote after they were given up."""
        return len(self._adrift)

    def write(self, scene: str, worker: int) -> int:
        """Registers a write by a worker and returns the number of the write, which is stored in the file."""
        self._writes += 1
        if worker != self._newest[scene]:
            self._adrift.add(self._writes)
        return self._writes

    def wrote(self, scene: str, index: int, worker: int) -> None:
        """Records that the file of a frame was written."""
        if worker == self._newest[scene]:
            self._kept.setdefault(scene, {})[index, worker] = None

    def report(self, scene: str, index: int, worker: int) -> None:
        """Records that the service learned of a committed frame."""
        if self._reported.setdefault(scene, {}).setdefault(index, worker) != worker:
            self._twice.setdefault(scene, set()).add(index)

    def untold(self, scene: str, count: int) -> list[int]:
        """Returns which of the first `count` frames, all of which are committed, have not been reported.

        Reported frames with index `count` or higher have disappeared, and count as run twice.
        """
        reported = self._reported.setdefault(scene, {})
        if gone := {index for index in reported if index >= count}:
            self._twice.setdefault(scene, set()).update(gone)
        return [index for index in range(count) if index not in reported]

    def check(self, scene: str, found: dict[int, FoundFrame], chain: Sequence[str]) -> FrameCounts:
        """Checks the frames of a scene that are read at the end, and returns their counts.

        Args:
            scene: scene id.
            found: the frames that were read, keyed by index.
            chain: contents of the frames in an undisturbed run.
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
        """Returns the sums of the counts of all scenes."""
        names = [name for name in FrameCounts.__dataclass_fields__ if name != "beside"]
        return FrameCounts(beside=self._beside, **{name: sum(getattr(one, name) for one in counts) for name in names})


@dataclass
class TimeRecord:
    """Placement and recovery times of each scene.

    Attributes:
        capacity: measures the time with room.
        now: function that returns the current time.
        placed: seconds with room until a worker was placed, and the part of them in which the head responded, keyed by
            the reason for the request.
        resumed: seconds from a failure until the scene continued, and the part of them without room, keyed by failure.
        waited: seconds that processes waited for a place, if longer than `WAIT_S`.
        unexplained: number of these processes whose scene was not told why it had to wait.
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
        """Number of workers without a place."""
        return len(self._wanted)

    def want(self, scene: str, reason: str, kind: int) -> None:
        """Records that a worker is needed, unless that is already recorded."""
        self._wanted.setdefault(scene, (reason, *self.capacity.seconds(kind)))

    def ask(self, scene: str) -> None:
        """Records that the service has requested a place."""
        self._asked[scene] = self.now()
        self._explained.discard(scene)

    def explain(self, scene: str) -> None:
        """Records that the scene was informed that no node has room."""
        self._explained.add(scene)

    def place(self, scene: str, kind: int) -> None:
        """Records that the scene's worker has a place on a running node."""
        if (wanted := self._wanted.pop(scene, None)) is None:
            return
        reason, *before = wanted
        room, answered = self.capacity.seconds(kind)
        self.placed.setdefault(reason, []).append((room - before[0], answered - before[1]))
        if (waited := self.now() - self._asked[scene]) > WAIT_S:
            self.waited.append(waited)
            self.unexplained += scene not in self._explained

    def forget(self) -> None:
        """Drops all requests, because the service is down."""
        self._wanted.clear()

    def drop(self, scene: str) -> None:
        """Removes a scene that has ended."""
        self._wanted.pop(scene, None)
        self._hit.pop(scene, None)

    def hit(self, scene: str, failure: str, at: float, kind: int) -> None:
        """Records a scene's failure at a time that may be in the past. An earlier unresolved failure has priority."""
        without = self.now() - self.capacity.seconds(kind)[0]
        self._hit.setdefault(scene, (failure, at, without))

    def resume(self, scene: str, kind: int) -> None:
        """Records that the scene continues after a failure."""
        if (hit := self._hit.pop(scene, None)) is not None:
            failure, at, before = hit
            without = self.now() - self.capacity.seconds(kind)[0] - before
            self.resumed.setdefault(failure, []).append((self.now() - at, max(0.0, without)))


def left_over(folder: Path) -> int:
    """Returns the number of epoch folders of a scene, complete or not, besides the current one."""
    return sum(name.startswith("states.") for name in os.listdir(folder)) - 1
