"""What the processes of a scene need of the core, as an interface: tests put a small fake in its place."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame, InitialPoints
from scas4d_core.storage.history import History

if TYPE_CHECKING:
    from scas4d_core.query.committed import View
    from scas4d_core.query.tracks import Tracks
    from scas4d_core.reconstruction import FrameReport, Progress, ResumePoint
    from scas4d_core.replay import Decode, Replayed


class Reconstruction(Protocol):
    """What the worker process owns: see `scas4d_core.reconstruction.Reconstruction`."""

    history: History
    resumed: ResumePoint | None

    def step(
        self,
        frame: Frame,
        *,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
        started: float | None = None,
    ) -> FrameReport:
        """Finds the state of the next frame and commits it to the history, with the report and what is given here.

        `started`: `perf_counter` when the work on the frame began, from where a budget counts.
        """

    def set_budget(
        self,
        *,
        iterations: int | None = None,
        budget_ms: float | None = None,
        stop_gain: float | None = None,
        still: float | None = None,
    ) -> None:
        """Another budget from the next step on; what is None is as the scene was made."""

    def write_checkpoint(self, index: int) -> bool:
        """Writes the checkpoint of the newest commit again; False for another one."""


class Reader(Protocol):
    """What the reader process owns: views, tracks and parts of the committed states. Cameras, points: user's world."""

    def render(
        self,
        camera: Camera,
        index: int,
        *,
        background: tuple[float, float, float],
        labels: NDArray[np.signedinteger] | None = None,
    ) -> View:
        """A novel view of a committed frame."""

    def tracks_of_points(self, points: NDArray[np.float64], index: int, indices: Sequence[int]) -> Tracks:
        """Trajectories of points [Q, 3] of frame `index`."""

    def tracks_of_pixels(self, camera: Camera, uv: NDArray[np.float64], index: int, indices: Sequence[int]) -> Tracks:
        """Trajectories of pixels [Q, 2] of frame `index`."""

    def tracks_of_ids(self, ids: NDArray[np.int64], indices: Sequence[int]) -> Tracks:
        """Trajectories of Gaussians."""

    def with_visibility(self, tracks: Tracks, camera: Camera, index: int) -> Tracks:
        """The same tracks, asked for at frame `index`, with their visibility in one more camera."""

    def parts(self, count: int | None, previous: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """[N] labels, 0 … count−1; parts that go on keep those of `previous`, found from fewer frames."""

    def write_ply(self, path: Path, index: int) -> None:
        """A committed frame as a 3DGS .ply."""


class Engine(Protocol):
    """Makes both. One object in each process of a scene."""

    def start(
        self,
        rig: Rig,
        frame: Frame,
        settings: Any,
        *,
        points: InitialPoints | None,
        progress: Callable[[Progress], None],
        history: History,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
        started: float | None = None,
    ) -> Reconstruction:
        """Reconstructs the first frame and commits it to the history, with its report and what is given here.

        `started`: as for `Reconstruction.step`.
        """

    def resume(self, rig: Rig, settings: Any, history: History, *, held: Callable[[int], bool] = ...) -> Reconstruction:
        """Goes on from the last commit of a history; `held`: whether a frame's pictures can be given again."""

    def reader(self, rig: Rig, settings: Any, history: History) -> Reader:
        """Reads what was committed to a history; made anew when the history has grown."""

    def replay(
        self,
        rig: Rig,
        settings: Any,
        history: History,
        base: int,
        frames: Sequence[Decode],
        iterations: int,
        over: Callable[[], None],
    ) -> Replayed:
        """Updates the frames after a committed one again, in memory, with another number of iterations."""

    def remake(
        self,
        rig: Rig,
        settings: Any,
        history: History,
        base: int,
        frame: Frame,
        budget: Mapping[str, Any],
        *,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Makes a committed state that was damaged again, from that of `base`; answers the report written with it."""

    def warm_up(self) -> None:
        """Compiles or loads what the first frames would wait for; called once, in a process of its own."""


class CoreEngine:
    """The method itself. Numba is imported where it is used: the door does without."""

    def start(
        self,
        rig: Rig,
        frame: Frame,
        settings: Any,
        *,
        points: InitialPoints | None,
        progress: Callable[[Progress], None],
        history: History,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
        started: float | None = None,
    ) -> Reconstruction:
        """`Reconstruction.start`."""
        _compile_beside(settings)
        from scas4d_core.reconstruction import Reconstruction

        return Reconstruction.start(
            rig, frame, settings, points=points, progress=progress, history=history, dropped=dropped, notes=notes,
            started=started,
        )  # fmt: skip

    def resume(
        self, rig: Rig, settings: Any, history: History, *, held: Callable[[int], bool] = lambda index: True
    ) -> Reconstruction:
        """`Reconstruction.resume`."""
        _compile_beside(settings)
        from scas4d_core.reconstruction import Reconstruction

        return Reconstruction.resume(rig, settings, history, held=held)

    def warm_up(self) -> None:
        """`scas4d_core.warm_up`."""
        from scas4d_core.warm_up import warm_up

        warm_up()

    def replay(
        self,
        rig: Rig,
        settings: Any,
        history: History,
        base: int,
        frames: Sequence[Decode],
        iterations: int,
        over: Callable[[], None],
    ) -> Replayed:
        """`scas4d_core.replay.replay`, on one thread: the others belong to the update."""
        from scas4d_core.replay import replay

        _compile_beside(settings)
        _one_thread()
        return replay(rig, settings, history, base, frames, iterations, over)

    def remake(
        self,
        rig: Rig,
        settings: Any,
        history: History,
        base: int,
        frame: Frame,
        budget: Mapping[str, Any],
        *,
        dropped: Mapping[str, str] | None = None,
        notes: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """`scas4d_core.remake.remake`."""
        from scas4d_core.remake import remake

        return remake(rig, settings, history, base, frame, budget, dropped=dropped, notes=notes)

    def reader(self, rig: Rig, settings: Any, history: History) -> Reader:
        """`CommittedScene`, on one thread: the others belong to the update."""
        from scas4d_core.cameras import rig_inside
        from scas4d_core.query.committed import CommittedScene
        from scas4d_core.rasterize.limits import scene_limits

        _one_thread()
        world = rig.world_frame(settings.scene.metres_per_unit)
        limits = scene_limits(settings.scene.near, rig_inside(world, rig.cameras).radius)
        return CommittedScene(history, world, limits)


def _compile_beside(settings: Any) -> None:
    """Has the kernels compiled in another process where the cache lacks them: this one would keep the memory."""
    from scas4d_core.warm_up import warm_up_elsewhere

    if settings.device == "cpu":
        warm_up_elsewhere()


def _one_thread() -> None:
    import numba
    from threadpoolctl import threadpool_limits

    numba.set_num_threads(1)
    threadpool_limits(1)  # of OpenMP and BLAS: scikit-learn's spin while they wait, 16 s for parts on busy cores


def core_engine() -> Engine:
    """The engine of the service."""
    return CoreEngine()


def load_engine(name: str) -> Engine:
    """The engine that `module:function` makes."""
    module, _, function = name.partition(":")
    engine: Engine = getattr(importlib.import_module(module), function)()
    return engine
