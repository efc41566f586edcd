"""Rendering pass of an iteration: renders a view, compares it, and backpropagates its loss to the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.engines.views import TrainingView
from scas4d_core.engines.warp.layout import COLUMNS
from scas4d_core.engines.warp.picture_loss import PictureLoss
from scas4d_core.engines.warp.projection import COUNTED_GUARDS
from scas4d_core.engines.warp.rasterizer import Rasterizer
from scas4d_core.guards import GuardCounts


class PicturePass:
    """Renders, compares and backpropagates the views of an iteration one after the other.

    ``launch`` and ``measure`` can be captured in a CUDA graph after each has run once, which compiles the kernels. A
    graph is valid while ``generation`` does not change.

    Args:
        device: Warp device, such as "cpu" or "cuda:0". plan: plan of the updates. count: N Gaussians.

    Attributes:
        grad_means, grad_factors, grad_features: [N] of vec3, mat33 and vec4, accumulated by ``launch``.
        planes: [5, rows, columns] of the last rendering: RGB before exposure, label, remaining transmittance.
        exposures: [views, 4] of vec2, gain and offset; may be changed between launches.
        log: [records, 8] float32, columns as in ``layout``.
        overflow: [1] int32, set to 1 if a picture is empty because its lists exceeded the capacity; see ``grow``.
        generation: number of times that buffers were replaced.
    """

    def __init__(self, device: str, plan: UpdatePlan, count: int) -> None:
        self._device = device
        self._rasterizer = Rasterizer(device, count, plan.limits)
        self._loss = PictureLoss(device, plan.image, plan.mask)
        self._background = wp.array([[*plan.background, 0.0]], dtype=wp.vec4, device=device)
        self.grad_means = wp.zeros(count, dtype=wp.vec3, device=device)
        self.grad_factors = wp.zeros(count, dtype=wp.mat33, device=device)
        self.grad_features = wp.zeros(count, dtype=wp.vec4, device=device)
        self.log = wp.zeros((1, COLUMNS), dtype=wp.float32, device=device)
        self.generation = 0

    @property
    def planes(self) -> wp.array:
        """See the class attributes."""
        return self._rasterizer.planes

    @property
    def exposures(self) -> wp.array:  # noqa: D102
        return self._loss.exposures

    @property
    def cameras(self) -> wp.array:
        """[views] of type ``layout.Camera``."""
        return self._loss.cameras

    @property
    def overflow(self) -> wp.array:  # noqa: D102
        return self._rasterizer.overflow

    def guards(self) -> GuardCounts:
        """Returns how often the rendering guards were triggered since ``forget_guards``; waits for the device."""
        counts = GuardCounts(*COUNTED_GUARDS)
        counts.add(COUNTED_GUARDS, self._rasterizer.guard_counts.numpy().astype(np.int64))
        return counts

    def forget_guards(self) -> None:
        """Resets the counts of the guards to 0."""
        self._rasterizer.guard_counts.zero_()

    def load_views(self, views: Sequence[TrainingView]) -> None:
        """Uploads the pictures, cameras and exposures of a frame; pictures that are already loaded are reused."""
        if self._loss.load(views):
            self._rasterizer.resize(self._loss.columns, self._loss.rows)
            self.generation += 1

    def reserve(self, records: int) -> None:
        """Allocates log rows for a number of records; the previous contents may be lost."""
        if records > self.log.shape[0]:
            self.log = wp.zeros((records, COLUMNS), dtype=wp.float32, device=self._device)
            self.generation += 1

    def grow(self) -> bool:
        """Enlarges the lists after an overflow and returns whether there was one; waits for the device."""
        grew = self._rasterizer.grow()
        self.generation += grew
        return grew

    def measure(
        self, view: wp.array, record: wp.array, means: wp.array, factors: wp.array, opacities: wp.array,
        features: wp.array,
    ) -> None:  # fmt: skip
        """Renders a view into ``planes`` and compares it; the losses are written to a row of the log.

        Args:
            view: [1] int32, index of the view. record: [1] int32, row of the log.
            means, factors, opacities, features: [N] of vec3, mat33, float32, and vec4 as the camera sees them; all
                contiguous.
        """
        cameras, log = self._loss.cameras, self.log
        self._rasterizer.project(cameras, view, means, factors, opacities, features, record, log)
        self._rasterizer.draw(cameras, view, features, self._background)
        self._loss.measure(view, record, self._rasterizer, self._background, log)

    def launch(
        self, view: wp.array, record: wp.array, means: wp.array, factors: wp.array, opacities: wp.array,
        features: wp.array, weight: float,
    ) -> None:  # fmt: skip
        """Runs ``measure`` and adds the gradients, times a weight, to ``grad_means`` etc."""
        self.measure(view, record, means, factors, opacities, features)
        rasterizer, cameras = self._rasterizer, self._loss.cameras
        self._loss.carry_back(view, rasterizer, weight)
        rasterizer.carry_back(cameras, view, features)
        gradients = self.grad_means, self.grad_factors, self.grad_features
        rasterizer.carry_to_world(cameras, view, means, factors, *gradients)
