"""CPU engine for fits, which runs one iteration of 3D Gaussian Splatting at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.cpu.gloss import GlossShading, features_seen, without_turn
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import EngineError
from scas4d_core.engines.fit import COLOUR, FitLoss, FitScalars, FitTable
from scas4d_core.engines.renderer import Gradients
from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels import activation
from scas4d_core.kernels.adam import EVERY_ROW, adam

Array = NDArray[np.float32]


class _Shapes(NamedTuple):
    """Arrays to render for a view, with the fixed Gaussians followed by the fitted ones."""

    means: Array
    factors: Array
    opacities: Array
    features: Array

    @classmethod
    def empty(cls, count: int) -> _Shapes:
        shapes = ((count, 3), (count, 3, 3), (count,), (count, 4))
        return cls(*[np.empty(shape, np.float32) for shape in shapes])

    @classmethod
    def beside(cls, fixed: Gaussians, camera: CameraArrays, count: int) -> _Shapes:
        """Returns arrays with the fixed Gaussians as seen by a camera, and space for ``count`` fitted Gaussians."""
        made, rows = cls.empty(len(fixed) + count), len(fixed)
        made.means[:rows], made.factors[:rows] = fixed.means, fixed.factors
        made.opacities[:rows], made.features[:rows] = fixed.opacities, features_seen(fixed, camera)
        return made

    def since(self, row: int) -> _Shapes:
        """Returns array views of all rows from ``row`` onwards."""
        return _Shapes(*[array[row:] for array in self])


class CpuFitEngine:
    """The CPU implementation of ``FitEngine``. It updates the arrays of the loaded table in place.

    Args:
        renderer: renderer to use, which also defines the loss weights.
    """

    def __init__(self, renderer: CpuRenderer) -> None:
        self.renderer = renderer
        self._views: Sequence[TrainingView] = ()
        self._fixed: Sequence[Gaussians] = ()

    def load_views(self, views: Sequence[TrainingView], fixed: Sequence[Gaussians] = ()) -> None:
        """See ``FitEngine.load_views``."""
        self._views, self._fixed = views, fixed

    def load_table(self, table: FitTable) -> None:
        """See ``FitEngine.load_table``."""
        if not isinstance(table.gloss, GlossShading | None):
            raise EngineError("cpu", ["gloss from another engine"])
        self._table, self._gloss, count = table, table.gloss, len(table.parameters)
        self._gradients = np.zeros_like(table.parameters)
        if self._fixed:
            pairs = zip(self._fixed, self._views, strict=True)
            self._shapes = [_Shapes.beside(fixed, view.camera, count) for fixed, view in pairs]
        else:
            self._shapes = [_Shapes.empty(count)] * len(self._views)

    def iterate(self, view: int, scalars: FitScalars) -> FitLoss:
        """See ``FitEngine.iterate``."""
        table, seen, drawn = self._table, self._views[view], self._shapes[view]
        fixed = len(drawn.means) - len(table.parameters)
        fitted = drawn.since(fixed)
        activation.activate(table.parameters, *fitted)
        gloss = self._gloss
        if gloss is not None:
            turns, colours = without_turn(len(fitted.means)), fitted.features[:, :3].copy()
            gloss.shade(fitted.means, turns, colours, seen.camera, fitted.features)
        gradients, g_features = self._backward(drawn, seen, scalars.rates)
        g_features = g_features[fixed:]
        shift = self.renderer.colour_shift(seen) if scalars.colour_shift else None
        if gloss is not None:
            gloss.shade_backward(fitted.means, turns, colours, seen.camera, g_features)
            gloss.step(scalars.gloss)
        if gradients is None:
            self._gradients[:] = 0
            self._gradients[:, COLOUR] = g_features[:, :3]
        else:
            activation.activate_backward(
                table.parameters, *fitted[1:], gradients.means[fixed:], gradients.factors[fixed:],
                gradients.opacities[fixed:], g_features, self._gradients,
            )  # fmt: skip
            self._record_rendering(fitted.factors, gradients.screen[fixed:], seen.camera, fixed)
        table.steps += 1
        moments = table.first, table.second
        adam(
            table.parameters, self._gradients, *moments, scalars.rates, EVERY_ROW, table.beta1, table.beta2, table.steps
        )
        loss = self.renderer.image_part + self.renderer.mask_part
        return FitLoss(view, loss, self.renderer.psnr, self.renderer.exposure_gradient, shift)

    def _backward(self, drawn: _Shapes, view: TrainingView, rates: Array) -> tuple[Gradients | None, Array]:
        """Returns the gradients of all rendered arrays, followed by the gradients of the features.

        If only colours are learned, the first item is None.
        """
        if rates[: COLOUR.start].any() or rates[COLOUR.stop :].any():
            gradients = self.renderer.forward_backward(*drawn, view)
            return gradients, gradients.features
        self.renderer.forward(*drawn, view)
        rasterizer = self.renderer.rasterizer
        return None, rasterizer.feature_gradients(rasterizer.gradient_buffers()[0])

    def _record_rendering(self, factors: Array, g_screen: Array, camera: CameraArrays, fixed: int) -> None:
        """Adds the last rendering to the statistics, if statistics are collected."""
        statistics = self._table.statistics
        if statistics is not None:
            half = np.array([camera.width / 2, camera.height / 2], np.float32)
            statistics.screen_gradients += np.sqrt(np.square(g_screen * half).sum(axis=1))
            statistics.rendered += self.renderer.rasterizer.counts[fixed:] > 0
            statistics.factors = factors

    def table(self) -> FitTable:
        """See ``FitEngine.table``."""
        return self._table

    def state(self) -> Gaussians:
        """See ``FitEngine.state``."""
        count, gloss = len(self._table.parameters), self._gloss
        made = _Shapes.empty(count)
        activation.activate(self._table.parameters, *made)
        return Gaussians(
            means=made.means,
            factors=made.factors,
            rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            opacities=made.opacities,
            colours=made.features[:, :3].copy(),
            foreground=made.features[:, 3].copy(),
            ids=np.arange(count, dtype=np.int64),
            gloss=None if gloss is None else gloss.gloss.copy(),
            environment=None if gloss is None else gloss.environment.copy(),
        )
