"""Work of a modelled worker: commits frames in order to its epoch's folder, and continues after it is given up."""

from __future__ import annotations

import asyncio
import hashlib
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from server.messages import FrameCommitted, FrameReady, Ready
from studies.simulation.cluster import SimulatedCluster
from studies.simulation.delays import ADRIFT_S, ADRIFT_UPDATE_S, QUICKEST_S, START_S, Range
from studies.simulation.record import FoundFrame, FrameRecord

SUFFIX = ".frame"


def content(before: str, index: int) -> str:
    """Returns the state of a frame, which depends only on the previous state, or on the scene's name for frame 0.

    >>> content("a", 0) == content("a", 0) != content("b", 0)
    True
    """
    return hashlib.blake2b(f"{before} {index}".encode(), digest_size=16).hexdigest()


def frame_file(folder: Path, index: int) -> Path:
    """Returns the path of a frame's file."""
    return folder / f"{index:06}{SUFFIX}"


def read_frame(path: Path) -> FoundFrame:
    """Reads the file of a frame and returns its contents."""
    state, worker, write = path.read_text().split()
    return FoundFrame(state, int(worker), int(write))


def listed(folder: Path) -> list[int]:
    """Returns the sorted indices of the frames in a folder."""
    names = (
        name
        for name in (os.listdir(folder) if folder.is_dir() else ())
        if name.endswith(SUFFIX) and not name.startswith(".")
    )
    return sorted(int(name.removesuffix(SUFFIX)) for name in names)


class _Timer:
    """One scheduled call that can be paused."""

    def __init__(self, cluster: SimulatedCluster) -> None:
        self._cluster = cluster
        self._handle: asyncio.TimerHandle | None = None
        self._call: Callable[[], None] | None = None
        self._left = 0.0
        self._paused = False

    def set(self, delay: Range | float, call: Callable[[], None]) -> None:
        """Schedules a call after a delay in seconds, excluding pauses, and cancels the previous call."""
        self.cancel()
        self._call = call
        self._left = self._cluster.random.uniform(*delay) if isinstance(delay, tuple) else delay
        if not self._paused:
            self.resume()

    def pause(self) -> None:
        self._paused = True
        if self._handle is not None:
            self._left = max(0.0, self._handle.when() - self._cluster.loop.time())
            self._handle.cancel()
            self._handle = None

    def resume(self) -> None:
        self._paused = False
        if self._call is not None and self._handle is None:
            self._handle = self._cluster.loop.call_later(self._left, self._due)

    def cancel(self) -> None:
        if self._handle is not None:
            self._handle.cancel()
        self._handle = self._call = None

    def _due(self) -> None:
        call, self._handle, self._call = self._call, None, None
        assert call is not None
        call()


class Work:
    """Work of a modelled worker process.

    After being given up, a modelled worker does more damage than a real one. Without any orders, it commits all
    acknowledged frames and repeatedly rewrites its own newest frame.

    Args:
        cluster: the modelled cluster.
        record: record of the frames.
        scene: scene id.
        folder: folder of the worker's epoch.
        worker: worker number.
        longest: longest duration of an update, in seconds.
        say: callback that sends a message to the service.
        gone: callback for when the worker exits on its own.
    """

    def __init__(
        self,
        cluster: SimulatedCluster,
        record: FrameRecord,
        scene: str,
        folder: Path,
        worker: int,
        longest: float,
        say: Callable[[Any], None],
        gone: Callable[[], None],
    ) -> None:
        self._cluster = cluster
        self._record = record
        self._scene, self._folder, self._worker, self._longest = scene, folder, worker, longest
        self._say, self._gone = say, gone
        self._frames = self._first_own = 0
        self._state = scene
        self._at: int | None = None
        self._opened = self._adrift = self._stopped = self._ended = False
        self._step, self._end = _Timer(cluster), _Timer(cluster)
        record.works.setdefault(scene, {})[self] = None
        self._step.set(START_S, self._open)

    def order(self, message: FrameReady) -> None:
        """Accepts a frame to process.

        Raises:
            RuntimeError: the frame is not the next one.
        """
        if self._ended or self._adrift or self._at is not None:
            return
        if message.index != self._frames:
            raise RuntimeError(
                f"scene {self._scene}: received frame {message.index}, but expected frame {self._frames}"
            )
        low, high = math.log(QUICKEST_S), math.log(max(QUICKEST_S, self._longest))
        self._begin(math.exp(self._cluster.random.uniform(low, high)))

    def pause(self) -> None:
        """Pauses, because the node is stopped."""
        self._stopped = True
        self._step.pause()
        self._end.pause()

    def resume(self) -> None:
        """Resumes, because the node has resumed."""
        self._stopped = False
        self._step.resume()
        self._end.resume()

    def drift(self) -> None:
        """Continues without orders for a while after the worker was given up."""
        if not self._adrift and not self._ended:
            self._adrift = True
            self._end.set(ADRIFT_S, self._leave)
            if self._opened and self._at is None:
                self._go_on()

    def hurry(self) -> None:
        """Commits the next frame immediately. The caller chooses the worst moment for this."""
        if not self._opened or self._stopped or self._ended:
            return
        if self._at is not None or (self._adrift and self._frames < self._record.acknowledged[self._scene]):
            self._step.cancel()
            self._commit()

    def end(self) -> None:
        """Ends immediately."""
        self._ended = True
        self._step.cancel()
        self._end.cancel()
        self._record.works[self._scene].pop(self, None)

    def _leave(self) -> None:
        if not self._ended:
            self.end()
            self._gone()

    def _open(self) -> None:
        try:
            self._frames = self._first_own = len(listed(self._folder))
            if self._frames:
                self._state = read_frame(frame_file(self._folder, self._frames - 1)).state
        except FileNotFoundError:  # the folder was removed: the worker was given up long ago
            self._leave()
            return
        self._opened = True
        self._say(Ready(tuple(range(self._frames))))
        if self._adrift:
            self._go_on()

    def _begin(self, seconds: float | Range) -> None:
        self._at = self._frames
        self._step.set(seconds, self._commit)

    def _commit(self) -> None:
        index = self._frames
        state = content(self._state, index)
        if self._write(index, state):
            self._at, self._state, self._frames = None, state, index + 1
            self._say(FrameCommitted(index, {"worker": self._worker}))
            if self._adrift:
                self._go_on()

    def _go_on(self) -> None:
        if self._frames < self._record.acknowledged[self._scene]:
            self._begin(ADRIFT_UPDATE_S)
        else:
            self._step.set(ADRIFT_UPDATE_S, self._again)

    def _again(self) -> None:
        """Rewrites its own newest frame with the same bytes."""
        if self._frames == self._first_own or self._write(self._frames - 1, self._state):
            self._go_on()

    def _write(self, index: int, state: str) -> bool:
        """Writes a frame atomically and returns True. If the folder was deleted, ends the worker and returns False."""
        path, number = frame_file(self._folder, index), self._record.write(self._scene, self._worker)
        beside = path.with_name(f".{path.name}.{self._worker}.part")
        try:
            with open(beside, "w") as file:
                file.write(f"{state} {self._worker} {number}")
            os.replace(beside, path)
        except FileNotFoundError:
            self._leave()
            return False
        self._record.wrote(self._scene, index, self._worker)
        return True
