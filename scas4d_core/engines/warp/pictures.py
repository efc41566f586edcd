"""Rendering pass of an iteration: renders a view, computes its loss, and backpropagates the loss to the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.engine import KEPT_PICTURES, KEPT_ROWS, Thinned, kept_step
from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.engines.renderer import CHANNELS
from scas4d_core.engines.views import TrainingView
from scas4d_core.engines.warp.layout import COLUMNS, Camera
from scas4d_core.engines.warp.picture_loss import PictureLoss
from scas4d_core.engines.warp.rasterizer import Rasterizer

wp.set_module_options({"enable_backward": False})


@wp.func
def step_of(camera: Camera) -> wp.int32:
    """Returns the subsampling factor of a kept rendering; see ``engine.kept_step``."""
    return wp.max(1, wp.min(camera.height, camera.width) // KEPT_ROWS)


@wp.kernel
def keep_picture(
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    slot: wp.array[wp.int32],
    planes: wp.array3d[wp.float32],
    kept: wp.array4d[wp.float32],
) -> None:
    """Copies a subsampled rendering to a slot, with one thread per element of the slot.

    Args:
        cameras: [views] cameras of all views.
        view: [1] index of the view.
        slot: [1] index of the slot.
        planes: [5, rows, columns] rendering.
        kept: [slots, 5, rows, columns] output, kept renderings.
    """
    plane, y, x = wp.tid()
    camera = cameras[view[0]]
    every = step_of(camera)
    if every * y < camera.height and every * x < camera.width:
        kept[slot[0], plane, y, x] = planes[plane, every * y, every * x]


class PicturePass:
    """Renders the views of an iteration one after another, and computes and backpropagates their losses.

    ``launch``, ``measure`` and ``keep`` can be captured in a CUDA graph after their first run, which compiles the
    kernels. A graph remains valid until ``generation`` changes.

    Args:
        device: Warp device, such as "cpu" or "cuda:0".
        plan: plan of the scene's updates.
        count: number of Gaussians, N.

    Attributes:
        grad_means, grad_factors, grad_features: [N] gradients of type vec3, mat33 and vec4, filled by ``launch``.
        planes: [5, rows, columns] last rendering: RGB before exposure, label, and remaining transmittance.
        exposures: [views, 4] vec2 gain and offset of each channel. They may be changed between launches.
        log: [records, 8] float32 log; see ``layout`` for the columns.
        kept: [slots, 5, rows, columns] float32 renderings that ``keep`` has copied, subsampled; see ``thinned``.
        generation: number of times that buffers were reallocated.
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
        self.kept = wp.zeros((0, 0, 0, 0), dtype=wp.float32, device=device)
        self.generation = 0

    @property
    def planes(self) -> wp.array:
        """Channels of the last rendering. See the class attributes."""
        return self._rasterizer.planes

    @property
    def exposures(self) -> wp.array:  # noqa: D102
        return self._loss.exposures

    @property
    def cameras(self) -> wp.array:
        """Cameras of all views [views], of type ``layout.Camera``."""
        return self._loss.cameras

    @property
    def targets(self) -> wp.array:
        """Training images and masks [views, 4, rows, columns]."""
        return self._loss.targets

    @property
    def guard_counts(self) -> wp.array:
        """Number of times each guard in ``projection.COUNTED_GUARDS`` was triggered [3]."""
        return self._rasterizer.guard_counts

    def forget_guards(self) -> None:
        """Resets the guard counts to 0."""
        self.guard_counts.zero_()

    def load_views(self, views: Sequence[TrainingView]) -> None:
        """Uploads the images, cameras and exposures of a frame. Images that are already loaded are reused."""
        replaced = self._loss.load(views)
        if not self._rasterizer.holds(self._loss.columns, self._loss.rows):
            self._rasterizer.resize(self._loss.columns, self._loss.rows)
            replaced = True
        sizes = [kept_size(view) for view in views]
        rows, columns = max(rows for rows, _ in sizes), max(columns for _, columns in sizes)
        if rows > self.kept.shape[2] or columns > self.kept.shape[3]:
            shape = (KEPT_PICTURES, CHANNELS + 1, max(rows, self.kept.shape[2]), max(columns, self.kept.shape[3]))
            self.kept = wp.zeros(shape, dtype=wp.float32, device=self._device)
            replaced = True
        self.generation += replaced

    def reserve(self, records: int) -> None:
        """Allocates log rows for at least ``records`` renderings. The contents of the log may be lost."""
        if records > self.log.shape[0]:
            self.log = wp.zeros((records, COLUMNS), dtype=wp.float32, device=self._device)
            self.generation += 1

    def grow(self, room: float) -> bool:
        """Enlarges the tile lists if an image needs more entries; see ``Rasterizer.grow``."""
        grew = self._rasterizer.grow(room)
        self.generation += grew
        return grew

    def measure(
        self, view: wp.array, record: wp.array, means: wp.array, factors: wp.array, opacities: wp.array,
        features: wp.array,
    ) -> None:  # fmt: skip
        """Renders a view into ``planes``, and writes its losses to a log row. All arrays must be contiguous.

        Args:
            view: [1] int32 index of the view.
            record: [1] int32 row of the log.
            means: [N] vec3 means.
            factors: [N] mat33 covariance factors.
            opacities: [N] float32 opacities.
            features: [N] vec4 features seen by the camera.
        """
        cameras, log = self._loss.cameras, self.log
        self._rasterizer.project(cameras, view, means, factors, opacities, features, record, log)
        self._rasterizer.draw(cameras, view, features, self._background)
        self._loss.measure(view, record, self._rasterizer, self._background, log)

    def launch(
        self, view: wp.array, record: wp.array, means: wp.array, factors: wp.array, opacities: wp.array,
        features: wp.array, weight: float, *, add: bool, grad_features: wp.array | None = None,
    ) -> None:  # fmt: skip
        """Renders a view like ``measure``, and backpropagates its losses to the Gaussians.

        Args:
            view, record, means, factors, opacities, features: see ``measure``.
            weight: factor that scales all gradients.
            add: whether to add to the gradients of another view instead of overwriting them.
            grad_features: [N] vec4 output for the gradients of the features, or None to use the attribute.
        """
        self.measure(view, record, means, factors, opacities, features)
        rasterizer, cameras = self._rasterizer, self._loss.cameras
        self._loss.carry_back(view, rasterizer, weight)
        rasterizer.carry_back(cameras, view, features)
        features_out = self.grad_features if grad_features is None else grad_features
        gradients = self.grad_means, self.grad_factors, features_out
        rasterizer.carry_to_world(cameras, view, means, factors, *gradients, add=add)

    def keep(self, view: wp.array, slot: wp.array) -> None:
        """Copies the last rendering, subsampled, to a slot. Both arguments are [1] int32 arrays."""
        inputs = [self._loss.cameras, view, slot, self.planes, self.kept]
        wp.launch(keep_picture, self.kept.shape[1:], inputs, device=self._device)


def thinned(kept: NDArray[np.float32], view: TrainingView) -> Thinned:
    """Returns the kept rendering of a view.

    Args:
        kept: [5, rows, columns] slot of ``PicturePass.kept``, which may be larger than the rendering.
        view: the rendered view.
    """
    rows, columns = kept_size(view)
    return Thinned(kept_step(view.camera.height, view.camera.width), kept[:, :rows, :columns].copy())


def kept_size(view: TrainingView) -> tuple[int, int]:
    """Returns the number of rows and columns in a view's kept rendering."""
    every = kept_step(view.camera.height, view.camera.width)
    return -(-view.camera.height // every), -(-view.camera.width // every)
