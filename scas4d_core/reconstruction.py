"""A ``Reconstruction`` holds Θ_t; ``step(frame)`` commits Θ_t = D_t(Θ_{t−1}), or raises and changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, isfinite
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig, WorldFrame, rig_inside
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.captures.images import resize_area
from scas4d_core.committed import Committed, View
from scas4d_core.device import require_device
from scas4d_core.floor import floor_inside
from scas4d_core.gaussians import Gaussians
from scas4d_core.hierarchy import build_hierarchy
from scas4d_core.history import History
from scas4d_core.initial_points import initial_points
from scas4d_core.motion_labels import moving_between
from scas4d_core.neighbours import build_neighbours
from scas4d_core.picture_loss import PictureLoss
from scas4d_core.rasterize.limits import scene_limits
from scas4d_core.settings import Settings
from scas4d_core.static_scene import StaticResult, fit_static_scene
from scas4d_core.update import CameraFit, FrameUpdate, Updated, Updater
from scas4d_core.views import TrainingView, ViewFactory, pictures_of
from scas4d_core.warm_start import Motion

__all__ = ["FrameReport", "Progress", "Reconstruction", "StepError", "View"]

NEW_LABELS = 0.01
"""Share of all Gaussians that must be found moving anew before the hierarchy is built again."""

REPORTED_ITERATIONS = 24
"""The report's training loss is a mean over this many last iterations: about one round of a rig's cameras."""


class StepError(ValueError):
    """A frame that cannot be stepped to; the state is as it was."""


@dataclass(frozen=True)
class Progress:
    """How far a long task is."""

    stage: str
    done: int
    total: int
    detail: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class FrameReport:
    """How the update of one frame went.

    Attributes:
        seconds: by stage. loss: each iteration's weighted sum. psnr: dB, over the training views of the last
            iterations, each as it was rendered then.
        moving, gaussians: how many Gaussians move, and are.
        cameras: by name, how well each camera's picture was met when it was last rendered: a bumped camera shows.
    """

    index: int
    time: float
    iterations: int
    seconds: dict[str, float]
    loss: list[float]
    psnr: float
    moving: int
    gaussians: int
    cameras: dict[str, CameraFit] = field(default_factory=dict)


class Reconstruction(Committed):
    """One scene, from frame 0 on. Made by ``start``.

    Attributes:
        rig: the training cameras inside, image-scaled. world: user's world to inside. history: what was committed.
    """

    def __init__(self, settings: Settings, rig: Rig, world: WorldFrame, history: History) -> None:
        super().__init__(history, world, scene_limits(settings.scene.near, rig.radius))
        self.settings = settings
        self.rig = rig
        self._factory = ViewFactory(rig)
        self._sizes: dict[str, tuple[int, int]] = {}
        self._exposures: dict[str, NDArray[np.float32]] = {}
        self.static: StaticResult | None = None
        self._motion: Motion | None = None
        self._masked = True
        self._labels: NDArray[np.bool_] | None = None
        self._seen: list[TrainingView] = []
        limits = scene_limits(settings.scene.near, rig.radius)
        self._picture = PictureLoss(self._factory, settings.scene.background, 1.0, 0.0, limits=limits)
        self._updater: Updater | None = None

    @classmethod
    def start(
        cls,
        rig: Rig,
        frame: Frame,
        settings: Settings,
        *,
        points: InitialPoints | None = None,
        progress: Callable[[Progress], None] | None = None,
        history: History | None = None,
        static: StaticResult | None = None,
    ) -> Reconstruction:
        """Reconstruct the first frame and commit it.

        Args:
            rig: training cameras, user's world, at the size of the frame's pictures.
            frame: with a picture of every camera, or of most; masks where there are.
            points: a first cloud in the user's world; without it one is made from the pictures.
            progress: told of each stage.
            history: where to commit to; in memory when left out.
            static: a frame 0 that was fitted before, taken as it is.

        Raises:
            DeviceError: the settings' device cannot be had here.
            ValueError: a time that is not finite, or pictures of another size.
        """
        if not isfinite(frame.time):
            raise ValueError(f"frame {frame.index}: time {frame.time} s must be finite")
        require_device(settings.device)
        world = rig.world_frame(settings.scene.metres_per_unit)
        scaled = rig_inside(world, rig.scaled(settings.scene.image_scale).cameras)
        self = cls(settings, scaled, world, History() if history is None else history)
        self._sizes = {camera.name: (camera.width, camera.height) for camera in rig.cameras}
        result = static or self._fit_static(rig, self._scaled(frame), points, progress or (lambda _: None))
        self.static = result
        self._exposures = result.exposures
        self._masked = len(frame.masks) > 0
        if not self._masked:
            self._seen = self._factory.views(self._scaled(frame), {}, use_masks=False)
        self._prepare(result.gaussians)
        self.history.append(frame.index, frame.time, result.gaussians)
        return self

    def _fit_static(
        self, rig: Rig, frame: Frame, points: InitialPoints | None, tell: Callable[[Progress], None]
    ) -> StaticResult:
        """Frame 0 from a first cloud, which is made from the pictures where none is given."""
        scene, static = self.settings.scene, self.settings.static
        if points is None:
            points = initial_points(
                rig.scaled(scene.image_scale), frame.images, frame.masks, None,
                lambda stage, done, total: tell(Progress(stage, done, total)),
            )  # fmt: skip
        return fit_static_scene(
            self._factory,
            self._factory.views(frame, {}),
            self.world.to_inside(points.positions),
            points.colours,
            points.foreground,
            scene,
            static,
            lambda done, loss: tell(Progress("fitting frame 0", done, static.iterations, {"loss": loss})),
        )

    def step(self, frame: Frame) -> FrameReport:
        """Update to a frame and commit.

        Raises:
            StepError: not later than the last frame, no picture of the rig, or a picture of another size.
        """
        last = self.history.indices[-1]
        if frame.index <= last:
            raise StepError(f"frame {frame.index} is not after the last committed frame {last}")
        seconds = frame.time - self.history.time(last)
        if not 0 < seconds < inf:
            raise StepError(f"frame {frame.index}: time {frame.time} s is not after {self.history.time(last)} s")
        started = perf_counter()
        try:
            views = self._factory.views(self._scaled(frame), self._exposures, self._uses_masks)
        except ValueError as error:
            raise StepError(str(error)) from error
        decoded = perf_counter() - started
        self._learn_what_moves(views)
        updated = self._update(views, seconds, frame.index)
        for name in ("means", "factors", "colours"):
            if not np.isfinite(getattr(updated.gaussians, name)).all():
                raise StepError(f"frame {frame.index}: the update left NaN or infinity in {name}; nothing is committed")
        self.history.append(frame.index, frame.time, updated.gaussians)
        self._motion = updated.motion
        if not self._masked:
            self._seen = views
        return self._report(frame, updated, decoded)

    @property
    def _uses_masks(self) -> bool:
        """Whether updates look at masks."""
        weights = self.settings.update.weights
        return self.settings.update.use_masks and max(weights.mask, weights.mask_alone) > 0

    def _learn_what_moves(self, views: list[TrainingView]) -> None:
        """Where frame 0 had no mask, the pictures tell what moves; what has moved once stays in the hierarchy.

        The labels become part of the state with the commit of this frame. A hierarchy of other Gaussians is a new one:
        the motion before does not fit it, and the update starts cold.
        """
        if self._masked or not self._seen:
            return
        state = self._state(None)
        found = moving_between(state, self._seen, views, self._picture)
        known = np.zeros(len(state), np.bool_) if self._labels is None else self._labels
        if (found & ~known).sum() > NEW_LABELS * len(state):
            self._labels = found | known
            self._motion = None
            self._prepare(self._labelled(self.history.gaussians(self.history.indices[0])))

    def _labelled(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians with the labels learnt from motion, where there are any."""
        return gaussians if self._labels is None else gaussians.replace(foreground=self._labels.astype(np.float32))

    def _update(self, views: list[TrainingView], seconds: float, seed: int) -> Updated:
        assert self._updater is not None
        return self._updater.run(self._labelled(self._state(None)), views, self._motion, seconds, seed)

    def _prepare(self, gaussians: Gaussians) -> None:
        """The hierarchy and the neighbour graph of what moves."""
        settings = self.settings.update
        hierarchy = build_hierarchy(
            gaussians.means, gaussians.moving, settings.clusters, settings.smallest_cluster, settings.seed
        )
        weights = settings.weights
        tied = weights.rigidity + weights.isometry + weights.rotation > 0
        neighbours = (
            build_neighbours(gaussians.means[hierarchy.rows], settings.neighbours, settings.neighbour_falloff)
            if tied
            else None
        )
        scene = self.settings.scene
        if scene.floor is not None:
            scene = scene.model_copy(update={"floor": floor_inside(scene.floor, self.world)})
        given = (self._factory, scene, settings, hierarchy, neighbours, gaussians)
        if self.settings.device == "cpu":
            self._updater = FrameUpdate(*given)
        else:
            from scas4d_core.update_device import DeviceUpdate  # torch is loaded only where it is used

            self._updater = DeviceUpdate(*given, device=self.settings.device)

    def _scaled(self, frame: Frame) -> Frame:
        """The frame with its pictures at the size of ``rig``."""
        if self.settings.scene.image_scale == 1.0:
            return frame
        sizes = {camera.name: (camera.width, camera.height) for camera in self.rig.cameras}
        images, masks = {}, {}
        for name, size in sizes.items():
            if name in frame.images:
                image, mask = pictures_of(frame, name, self._sizes[name])
                images[name] = resize_area(image, size)
                if mask is not None:
                    masks[name] = (resize_area(255 * mask, size) >= 128).astype(np.uint8)
        return Frame(frame.index, frame.time, images, masks)

    def _report(self, frame: Frame, updated: Updated, decoded: float) -> FrameReport:
        return FrameReport(
            index=frame.index,
            time=frame.time,
            iterations=len(updated.losses),
            seconds={"decode": decoded, **updated.seconds},
            loss=updated.losses,
            psnr=float(np.mean(updated.psnr[-REPORTED_ITERATIONS:])),
            moving=len(self._updater.hierarchy.rows) if self._updater else 0,
            gaussians=len(updated.gaussians),
            cameras=updated.cameras,
        )
