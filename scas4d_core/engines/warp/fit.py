"""GPU engine for fits, which runs one iteration of 3D Gaussian Splatting at a time in Warp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from scas4d_core.engines.cpu.gloss import GlossShading
from scas4d_core.engines.engine import EngineError
from scas4d_core.engines.fit import COLUMNS as PARAMETERS
from scas4d_core.engines.fit import FitGloss, FitLoss, FitScalars, FitTable, RenderingStatistics
from scas4d_core.engines.renderer import CHANNELS, psnr_of
from scas4d_core.engines.views import LABEL, CameraArrays, TrainingView
from scas4d_core.engines.warp.activation import activate, step_parameters
from scas4d_core.engines.warp.adam import IDLE, SCALARS, Optimizer
from scas4d_core.engines.warp.copies import copies_on
from scas4d_core.engines.warp.downloads import Downloads
from scas4d_core.engines.warp.gloss import GlossTables, features_seen
from scas4d_core.engines.warp.layout import COLUMNS, IMAGE_LOSS, MASK_LOSS, PAIRS, SHIFT, SQUARES, Camera, camera_of
from scas4d_core.engines.warp.picture_loss import PictureLoss
from scas4d_core.engines.warp.rasterizer import Rasterizer
from scas4d_core.engines.warp.renderer import WarpRenderer
from scas4d_core.gaussians import Gaussians

wp.set_module_options({"enable_backward": False})

Array = NDArray[np.float32]


@wp.kernel
def skip_incomplete(capacity: wp.int32, log: wp.array2d[wp.float32], scalars: wp.array[wp.float32]) -> None:
    """Disables the step of each optimizer if the tile lists were too small, with one thread per optimizer."""
    if log[0, PAIRS] > wp.float32(capacity):
        scalars[SCALARS * wp.tid()] = 0.0


class _Shapes(NamedTuple):
    """Arrays to render for a view, with the fixed Gaussians followed by the fitted ones.

    Attributes:
        fixed: number of fixed Gaussians.
        means, factors, opacities, features: arrays of type vec3, mat33, float32 and vec4, respectively.
    """

    fixed: int
    means: wp.array
    factors: wp.array
    opacities: wp.array
    features: wp.array

    @classmethod
    def empty(cls, count: int, device: str) -> _Shapes:
        kinds = wp.vec3, wp.mat33, wp.float32, wp.vec4
        return cls(0, *(wp.zeros(count, dtype=kind, device=device) for kind in kinds))

    def since(self, row: int) -> _Shapes:
        """Returns array views of all rows from ``row`` onwards."""
        return _Shapes(0, *(array[row:] for array in self[1:]))

    @classmethod
    def beside(cls, fixed: Gaussians, camera: CameraArrays, count: int, device: str) -> _Shapes:
        """Returns arrays with the fixed Gaussians as seen by a camera, and space for ``count`` fitted Gaussians."""
        rows = len(fixed)
        made = cls.empty(rows + count, device)._replace(fixed=rows)
        if rows:
            copies, cameras = copies_on(device), wp.array([camera_of(camera)], dtype=Camera, device=device)
            kinds = {"means": wp.vec3, "factors": wp.mat33, "opacities": wp.float32}
            shapes = [copies.of(getattr(fixed, name), kind) for name, kind in kinds.items()]
            for array, given in zip(made[1:], [*shapes, features_seen(copies, fixed, cameras)], strict=True):
                wp.copy(array, given, count=rows)
        return made


class WarpFitEngine:
    """The ``FitEngine`` implementation in NVIDIA Warp. The host waits once per iteration, to read its loss.

    Args:
        renderer: renderer to use, which also determines the device.
        mask_weight: weight of the mask loss.
    """

    def __init__(self, renderer: WarpRenderer, mask_weight: float) -> None:
        self.renderer, self._device = renderer, renderer.device
        self._loss = PictureLoss(self._device, 1.0, mask_weight, everywhere=True)
        self._detached = mask_weight != 0
        self._background = wp.array([[*renderer.background, 0.0]], dtype=wp.vec4, device=self._device)
        self._downloads = Downloads(self._device)
        self._rasterizer = Rasterizer(self._device, 0, renderer.limits)
        self._scalars = wp.zeros(3 * SCALARS, dtype=wp.float32, device=self._device)
        self._view, self._row = (wp.zeros(1, dtype=wp.int32, device=self._device) for _ in range(2))
        self._log = wp.zeros((1, COLUMNS), dtype=wp.float32, device=self._device)
        self._g_exposure = wp.zeros(CHANNELS, dtype=wp.vec2, device=self._device)
        self._views: Sequence[TrainingView] = ()
        self._fixed: Sequence[Gaussians] = ()

    def load_views(self, views: Sequence[TrainingView], fixed: Sequence[Gaussians] = ()) -> None:
        """See ``FitEngine.load_views``."""
        self._views, self._fixed = views, fixed
        self._loss.load(views)

    def load_table(self, table: FitTable) -> None:
        """See ``FitEngine.load_table``."""
        if not isinstance(table.gloss, GlossShading | None):
            raise EngineError("warp", ["gloss from another engine"])
        device, count = self._device, len(table.parameters)
        self._table, self._count, self._stepped = table, count, False
        self._parameters = wp.array(table.parameters, dtype=wp.float32, ndim=2, device=device)
        self._optimizer = Optimizer((count, PARAMETERS), self._scalars[:SCALARS])
        self._optimizer.begin([0.0] * PARAMETERS, (float(table.beta1), float(table.beta2)))
        self._optimizer.load(table.first, table.second, table.steps)
        if self._fixed:
            pairs = zip(self._fixed, self._views, strict=True)
            self._shapes = [_Shapes.beside(fixed, view.camera, count, device) for fixed, view in pairs]
        else:
            self._shapes = [_Shapes.empty(count, device)] * len(self._views)
        most = max(shapes.fixed for shapes in self._shapes) + count
        capacity = self._rasterizer.capacity
        self._rasterizer = Rasterizer(device, most, self.renderer.limits, self._detached)
        self._rasterizer.capacity = max(capacity, self._rasterizer.capacity)
        self._rasterizer.resize(self._loss.columns, self._loss.rows)
        self._gradients = [wp.zeros(most, dtype=kind, device=device) for kind in (wp.vec3, wp.mat33, wp.vec4)]
        statistics = table.statistics or RenderingStatistics.empty(count)
        self._screen = wp.array(statistics.screen_gradients, dtype=wp.float32, device=device)
        self._rendered = wp.array(statistics.rendered, dtype=wp.int32, device=device)
        self._factors: wp.array | None = None
        self._load_gloss(table.gloss, most)

    def _load_gloss(self, shading: GlossShading | None, most: int) -> None:
        """Loads the gloss and environment with their moments. ``most`` is the largest number of rendered Gaussians."""
        self._gloss: GlossTables | None = None
        if shading is not None:
            self._seen = wp.zeros(most, dtype=wp.vec4, device=self._device)
            scalars = self._scalars[SCALARS : 2 * SCALARS], self._scalars[2 * SCALARS :]
            entries = wp.full(self._count, -1, dtype=wp.int32, device=self._device)
            self._gloss = GlossTables(entries, len(shading.gloss), scalars)
            self._gloss.begin(shading.rates)
            values = zip((shading.gloss, shading.environment), shading.moments, strict=True)
            for table, optimizer, (given, moments) in zip(
                self._gloss.tables, self._gloss.optimizers, values, strict=True
            ):
                table.assign(given)
                optimizer.load(moments[0], moments[1], shading.steps)

    def iterate(self, view: int, scalars: FitScalars) -> FitLoss:
        """See ``FitEngine.iterate``."""
        seen, shapes, gloss = self._views[view], self._shapes[view], self._gloss
        self._view.fill_(view)
        self._loss.set_exposure(view, seen)
        self._optimizer.set_columns(scalars.rates)
        steps = [*self._optimizer.next_scalars(1.0)]
        for place in range(2):
            steps += IDLE if gloss is None else gloss.optimizers[place].next_scalars(scalars.gloss)
        self._stepped = True
        row = self._launch(shapes, steps)
        while self._rasterizer.grow(row[PAIRS]):
            row = self._launch(shapes, steps)
        shift = tuple(row[SHIFT : SHIFT + LABEL].tolist()) if scalars.colour_shift else None
        psnr = psnr_of(row[SQUARES], seen.camera.width * seen.camera.height)
        exposure_gradient = self._exposure_gradient[: len(seen.target)]
        return FitLoss(view, row[IMAGE_LOSS] + row[MASK_LOSS], psnr, exposure_gradient, shift)

    def _launch(self, shapes: _Shapes, scalars: Sequence[float]) -> NDArray[np.float64]:
        """Runs an iteration and returns its log row. If the tile lists are too small, no parameter is updated."""
        device, gloss, rasterizer = self._device, self._gloss, self._rasterizer
        self._scalars.assign(np.array(scalars, np.float32))
        given = [shapes.fixed, self._parameters, *shapes[1:]]
        wp.launch(activate, self._count, given, device=device)
        cameras, view, features = self._loss.cameras, self._view, shapes.features
        fitted = shapes.since(shapes.fixed)
        if gloss is not None:
            gloss.shade(cameras, view, fitted.means, None, fitted.features, gloss.tables)
            features = self._seen
            wp.copy(features, shapes.features, count=shapes.fixed)
            wp.copy(features, gloss.seen, dest_offset=shapes.fixed, count=self._count)
        rasterizer.draw_fewer(shapes.fixed + self._count)
        seen = shapes.means, shapes.factors, shapes.opacities, features
        rasterizer.project(cameras, view, *seen, self._row, self._log)
        rasterizer.draw(cameras, view, features, self._background)
        self._loss.measure(view, self._row, rasterizer, self._background, self._log)
        wp.launch(skip_incomplete, 3, [rasterizer.capacity, self._log, self._scalars], device=device)
        self._loss.carry_back(view, rasterizer, 1.0)
        self._loss.exposure_gradient(view, rasterizer, self._g_exposure)
        rasterizer.carry_back(cameras, view, features)
        g_means, g_factors, g_features = self._gradients
        rasterizer.carry_to_world(cameras, view, shapes.means, shapes.factors, *self._gradients, add=False)
        if gloss is not None:
            wp.copy(gloss.g_seen, g_features, src_offset=shapes.fixed, count=self._count)
            own = g_features[shapes.fixed : shapes.fixed + self._count]
            gloss.shade_backward(cameras, view, fitted.means, None, fitted.features, own, add=False)
            gloss.step()
        drawn = [rasterizer.splats, rasterizer.records, shapes.factors, shapes.opacities, shapes.features]
        inputs = [shapes.fixed, cameras, view, *drawn, g_means, g_factors, g_features, self._optimizer.adam]
        inputs += [self._parameters, self._screen, self._rendered]
        wp.launch(step_parameters, self._count, inputs, device=device)
        self._factors = fitted.factors
        log, self._exposure_gradient = self._downloads.read(self._log, self._g_exposure)
        row: NDArray[np.float64] = log[0].astype(np.float64)
        return row

    def table(self) -> FitTable:
        """See ``FitEngine.table``. Downloads the table only if iterations have run since the last download."""
        if not self._stepped:  # the host may have edited the table
            return self._table
        self._stepped = False
        table, adam = self._table, self._optimizer.adam
        arrays = [self._parameters, adam.first, adam.second, self._screen, self._rendered]
        parameters, first, second, screen, rendered = self._downloads.read(*arrays)
        statistics = table.statistics
        if statistics is not None:
            factors = statistics.factors if self._factors is None else self._downloads.read(self._factors)[0]
            statistics = RenderingStatistics(screen.astype(np.float64), rendered.astype(np.int64), factors)
        steps = self._optimizer.steps
        self._table = replace(
            table, parameters=parameters, first=first, second=second, steps=steps, statistics=statistics,
            gloss=self._read_gloss(table.gloss),
        )  # fmt: skip
        return self._table

    def _read_gloss(self, shading: FitGloss | None) -> FitGloss | None:
        """Copies gloss, environment and moments from the device to ``shading``, and returns ``shading``."""
        if self._gloss is not None and isinstance(shading, GlossShading):
            for table, optimizer, values, moments in zip(
                self._gloss.tables, self._gloss.optimizers, (shading.gloss, shading.environment), shading.moments,
                strict=True,
            ):  # fmt: skip
                values[:], moments[0], moments[1] = self._downloads.read(
                    table, optimizer.adam.first, optimizer.adam.second
                )
            shading.steps = self._gloss.optimizers[0].steps
        return shading

    def state(self) -> Gaussians:
        """See ``FitEngine.state``."""
        made = _Shapes.empty(self._count, self._device)
        wp.launch(activate, self._count, [0, self._parameters, *made[1:]], device=self._device)
        arrays = [*made[1:], *([] if self._gloss is None else self._gloss.tables)]
        means, factors, opacities, features, *gloss = self._downloads.read(*arrays)
        return Gaussians(
            means=means,
            factors=factors,
            rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (self._count, 1)),
            opacities=opacities,
            colours=np.ascontiguousarray(features[:, :LABEL]),
            foreground=np.ascontiguousarray(features[:, LABEL]),
            ids=np.arange(self._count, dtype=np.int64),
            gloss=gloss[0] if gloss else None,
            environment=gloss[1] if gloss else None,
        )
