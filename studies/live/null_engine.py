"""Null engine: an engine whose iterations and renderings do nothing, so that a frame costs only what surrounds them.

Θ_t is Θ_{t−1} moved by the predicted motion, and every rendering equals its image. Ingest, decoding, checks, commits,
durability and messages are the real ones, as is the fit of frame 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from scas4d_core import preparation, reconstruction
from scas4d_core.engines.choose import Device
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import REPORT, Probe, StepScalars, Thinned, UpdateEngine, ViewRecord
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.plan import Structure, UpdatePlan
from scas4d_core.engines.renderer import CHANNELS, Comparison, Picture, Renderer
from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]

PSNR_DB, LOSS = 30.0, 0.03


class NullRenderer(CpuRenderer):
    """Renderer that finds every image equal to its rendering.

    Attributes:
        images: [3, H, W] image of the current frame for each camera, keyed by pose and lens.
    """

    images: ClassVar[dict[bytes, Array]] = {}

    def render(
        self,
        state: Gaussians,
        camera: CameraArrays,
        features: Array | None = None,
        *,
        depth_channel: int = -1,
        background: Array | None = None,
    ) -> Picture:
        """Returns the camera's image, opaque and with label 1, or black if there is none."""
        channels = CHANNELS if features is None else features.shape[1]
        planes = np.ones((channels, camera.height, camera.width), np.float32)
        planes[:3] = self.images.get(_key(camera), 0.0)
        return Picture(planes, np.zeros((camera.height, camera.width), np.float32))

    def compare(self, state: Gaussians, views: Sequence[TrainingView]) -> list[Comparison]:
        """Returns the same figures for every view."""
        return [Comparison(PSNR_DB, LOSS, (0.0, 0.0, 0.0)) for _ in views]

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """Returns zeros: no Gaussian is in a changed pixel."""
        return np.zeros((len(state), len(planes)), np.float32)

    def pairs_per_pixel(
        self, state: Gaussians, cameras: Sequence[CameraArrays], every: int = 1
    ) -> list[NDArray[np.int32]]:
        """Returns zeros."""
        return [np.zeros((-(-each.height // every), -(-each.width // every)), np.int32) for each in cameras]

    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """Returns zeros."""
        return np.zeros((len(state), 3), np.float32), np.zeros(len(state), np.float32)

    def step_colours(
        self, state: Gaussians, subsets: Sequence[Sequence[TrainingView]], learnt: NDArray[np.uint8], most: float
    ) -> Gaussians:
        """Returns the state unchanged."""
        return state


class NullEngine(CpuEngine):
    """CPU engine whose iterations neither render nor optimize, and whose probe views always give the same loss."""

    name = "null"

    def bind(self, plan: UpdatePlan, structure: Structure) -> None:
        """See ``UpdateEngine.bind``."""
        super().bind(plan, structure)
        self.renderer = NullRenderer(plan.background, plan.image, plan.mask, limits=plan.limits)

    def load_views(self, views: Sequence[TrainingView], probes: Sequence[TrainingView]) -> None:
        """See ``UpdateEngine.load_views``. The renderer then shows the images of the views."""
        super().load_views(views, probes)
        NullRenderer.images = {_key(view.camera): view.target[:3] for view in views}

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """Logs a loss, and for each view a PSNR and its image as the rendering."""
        self._log.losses.append(LOSS)
        for index in views:
            self._log.rendered.append(ViewRecord(index, PSNR_DB, (0.0, 0.0, 0.0)))
            if step.keep_pictures:
                target = self._views[index].target
                features = np.concatenate([target[:3], np.ones_like(target[:1])])
                self._log.keep(index, Thinned.of(features, np.zeros_like(target[0])))
        self._start.lap(REPORT)

    def probe(self, *probes: Probe, state_next: bool = False) -> list[list[float]]:
        """Returns the same loss for every probe view."""
        return [[LOSS for _ in probe.views] for probe in probes]


def _key(camera: CameraArrays) -> bytes:
    return camera.pose.tobytes() + camera.lens.tobytes()


def install() -> None:
    """Makes this process run all updates on the null engine."""

    def null_engine(device: Device) -> UpdateEngine:
        return NullEngine()

    def null_renderer(device: Device, background: tuple[float, float, float], limits: Limits) -> Renderer:
        return NullRenderer(background, limits=limits)

    setattr(preparation, "engine_of", null_engine)  # noqa: B010
    setattr(reconstruction, "renderer_of", null_renderer)  # noqa: B010
