"""Colours that depend on direction, as a camera sees them; and what they are made of, learnt.

``kernels.appearance.direction`` has the formula, and is loaded only where something is glossy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]

GLOSS = np.float32(0.5)
"""Strength that a Gaussian starts with. Only its product with the environment is seen: those of what is as glossy stay
near it, and the environment has the rest."""
RATE_GLOSS, RATE_ENVIRONMENT, RATE_NEARNESS = 1e-3, 2e-2, 5e-3
"""Adam rates in frame 0; that of the gloss at a strength of ``GLOSS`` (``gloss_rate``). Gloss that each Gaussian learns
fast explains one camera's highlight by itself: on `gloss` test pictures lost 0.6 dB at 5e-3 for strengths and 3e-3 for
normals."""
UPDATE_RATE_GLOSS, UPDATE_RATE_ENVIRONMENT, UPDATE_RATE_NEARNESS = 2e-3, 1e-2, 1e-3
"""The same in an update, where they fall to a tenth."""
NEARNESS = 0.3
"""1/m, of the environment before any is learnt: lamps of a room."""
NEIGHBOURS = 16
"""Over so many the changes of normals and strengths are averaged: a surface bends slowly, a highlight is small."""
SAME_SIDE = 0.5
"""Cosine between normals above which neighbours are of one surface."""


def without_turn(count: int) -> Array:
    """[count, 4] quaternions that turn nothing."""
    turns = np.zeros((count, 4), np.float32)
    turns[:, 0] = 1
    return turns


def features_seen(gaussians: Gaussians, camera: CameraArrays, turns: Array | None = None) -> Array:
    """[N, 4] the features of a state as a camera sees them: RGB and label. See ``colours_seen``."""
    return gaussians.features(colours_seen(gaussians, camera, turns))


def colours_seen(gaussians: Gaussians, camera: CameraArrays, turns: Array | None = None) -> Array:
    """[N, 3] the colours of a state as a camera sees them; the state's own array where they depend on no direction.

    Args:
        turns: [N, 4] unit quaternions by which the Gaussians have turned since their gloss was known; None: not at all.
    """
    if gaussians.gloss is None or gaussians.environment is None:
        return gaussians.colours
    from scas4d_core.kernels.appearance.direction import shade

    shown = np.empty((len(gaussians), 4), np.float32)
    shade(
        gaussians.means, gaussians.gloss, without_turn(len(gaussians)) if turns is None else turns, gaussians.colours,
        gaussians.environment, camera.centre, shown,
    )  # fmt: skip
    return np.ascontiguousarray(shown[:, :3])


def gloss_rate(rate: float, gloss: Array) -> float:
    """The rate of a gloss [M, 3] that turns its normals as fast as ``rate`` those of a strength of ``GLOSS``.

    Only strength times environment is seen, and a step is as long whatever the strength: at a fifth of it normals turn
    five times as fast. On `gloss` that cost frame 0 0.6 dB. The strength is the mean, weighted by itself: what is dull
    has no normal to turn.

    >>> gloss_rate(1e-3, np.array([[0.1, 0, 0], [0, 0, 0.1], [0, 0, 0]], np.float32))
    0.0002
    """
    strengths = np.linalg.norm(gloss.astype(np.float64), axis=1)
    typical = float(np.square(strengths).sum() / max(strengths.sum(), 1e-9))
    return round(rate * typical / float(GLOSS), 9)


class GlossShading:
    """Gloss and environment as parameters, with their gradients and steps.

    Args:
        gloss: [M, 3] normals times strengths; changed in place. environment: [ROWS, 3]; changed in place.
        rates: of the gloss, the environment, its nearness.
    """

    def __init__(self, gloss: Array, environment: Array, rates: tuple[float, float, float]) -> None:
        from scas4d_core.kernels.appearance import direction

        self._kernel = direction
        self.gloss, self.environment = gloss, environment
        self.changed_from, self._rates = gloss.copy(), rates
        self._turned = np.empty_like(gloss)
        self.gradients = np.zeros_like(gloss), np.zeros_like(environment)
        self.moments = [np.zeros((2, *table.shape), np.float32) for table in (gloss, environment)]
        self._columns = np.array([rates[0]] * 3, np.float32)
        self._by_row = np.full(len(environment), rates[1], np.float32)
        self._by_row[direction.MIDDLE], self._by_row[direction.NEARNESS] = 0, rates[2]
        self._cells = _cell_areas(direction.SIDE)
        self._seen = self._steps = 0
        self._near: tuple[Any, Any] | None = None

    @classmethod
    def fresh(cls, gloss: Array, means: Array, environment: Array | None = None) -> GlossShading:
        """With an environment of nothing, unless one is given; the middle is that of the means."""
        from scas4d_core.kernels.appearance import direction

        if environment is None:
            environment = np.zeros((direction.ROWS, 3), np.float32)
            environment[direction.MIDDLE] = np.median(means, axis=0)
            environment[direction.NEARNESS, 0] = NEARNESS
        return cls(gloss, environment, (gloss_rate(RATE_GLOSS, gloss), RATE_ENVIRONMENT, RATE_NEARNESS))

    def shade(self, means: Array, turns: Array, colours: Array, camera: CameraArrays, features: Array) -> None:
        """Fills RGB of ``features`` [N, 4] as a camera sees them."""
        self._kernel.shade(means, self.gloss, turns, colours, self.environment, camera.centre, features)

    def shade_backward(
        self, means: Array, turns: Array, colours: Array, camera: CameraArrays, g_features: Array
    ) -> None:
        """Turns the gradient of the features into that of the colours, and keeps what is its own."""
        g_environment = self._kernel.shade_backward(
            means, self.gloss, turns, colours, self.environment, camera.centre, g_features, self._turned
        )
        if self._seen == 0:
            for gradient in self.gradients:
                gradient[:] = 0
        self.gradients[0][:] += self._turned
        self.gradients[1][:] += g_environment
        self._seen += 1

    def step(self, factor: float = 1.0) -> None:
        """A step of Adam over the mean of what was seen since the last; the environment then sums to nothing."""
        from scas4d_core.kernels.adam import EVERY_ROW, adam

        self._steps += 1
        beta1, beta2 = np.float32(0.9), np.float32(0.999)
        ones = np.full(3, factor, np.float32)
        for table, gradient, moments, columns, by_row in (
            (self.gloss, self.gradients[0], self.moments[0], self._columns * np.float32(factor), EVERY_ROW),
            (self.environment, self.gradients[1], self.moments[1], ones, self._by_row),
        ):
            gradient /= np.float32(max(self._seen, 1))
            adam(table, gradient, moments[0], moments[1], columns, by_row, beta1, beta2, self._steps)
        self._seen = 0
        cells = self.environment[: self._kernel.CELLS]
        cells -= (self._cells[:, None] * cells).sum(axis=0)
        nearness = self.environment[self._kernel.NEARNESS]
        np.clip(nearness, 0, None, out=nearness)

    def select_rows(self, rows: NDArray[np.int64], parents: NDArray[np.int64]) -> GlossShading:
        """The same for some rows, with their moments, and for further ones like their parents, without."""
        every = np.concatenate([rows, parents])
        chosen = GlossShading(self.gloss[every], self.environment, self._rates)
        moments = self.moments[0][:, every]
        moments[:, len(rows) :] = 0
        chosen.moments = [np.ascontiguousarray(moments), self.moments[1]]
        chosen.changed_from, chosen._steps = self.changed_from[every], self._steps
        return chosen

    def smooth(self, means: Array) -> None:
        """Averages the changes since ``changed_from`` over neighbours on the same side of a surface.

        Args:
            means: [N, 3] by which the neighbours are found, the first time.
        """
        count = len(self.gloss)
        if self._near is None:
            index = cKDTree(means[:count]).query(means[:count], min(NEIGHBOURS, count))[1].reshape(count, -1)
            normals = self.gloss / np.maximum(np.linalg.norm(self.gloss, axis=1, keepdims=True), 1e-9)
            weights = (np.einsum("nkc,nc->nk", normals[index], normals) > SAME_SIDE).astype(np.float32)
            weights[:, 0] = 1
            self._near = index, weights / weights.sum(axis=1, keepdims=True)
        index, weights = self._near
        change = (self.gloss - self.changed_from)[index]
        self.gloss[:] = self.changed_from + np.einsum("nkc,nk->nc", change, weights)


def _cell_areas(side: int) -> Array:
    """[side²] share of the sphere of each cell of an octahedral map; sums to 1."""
    u, v = np.meshgrid(*[np.linspace(-1, 1, side)] * 2)
    x, y, z = u, v, 1 - abs(u) - abs(v)
    # The area of the sphere behind a piece of the map goes as 1/|p|³; rows at the rim stand for half a cell.
    fold = z < 0
    x, y = np.where(fold, (1 - abs(v)) * np.sign(u), u), np.where(fold, (1 - abs(u)) * np.sign(v), v)
    area = (x * x + y * y + z * z) ** -1.5
    area[[0, -1]] /= 2
    area[:, [0, -1]] /= 2
    shares: Array = (area / area.sum()).astype(np.float32).ravel()
    return shares


class LearntGloss:
    """Gloss and environment as parameters of an attempt, and the turns by which normals follow the deformation.

    Args:
        gloss, environment: of Θ_{t−1}; the gloss is kept as it was turned there. count: N.
        rows: [M] the moving Gaussians. roots: [N, 3] metres, places in frame 0, which give the neighbours.
    """

    def __init__(self, gloss: Array, environment: Array, count: int, rows: NDArray[np.int64], roots: Array) -> None:
        rates = (gloss_rate(UPDATE_RATE_GLOSS, gloss), UPDATE_RATE_ENVIRONMENT, UPDATE_RATE_NEARNESS)
        self._shading = GlossShading(gloss.copy(), environment.copy(), rates)
        self._turns, self._rows, self._roots = without_turn(count), rows, roots

    @property
    def gloss(self) -> Array:
        """[M, 3] as learnt so far, not yet turned."""
        return self._shading.gloss

    @property
    def environment(self) -> Array:
        """The environment as learnt so far."""
        return self._shading.environment

    def shade(self, means: Array, turns: Array, colours: Array, camera: CameraArrays, features: Array) -> None:
        """Fill RGB of ``features`` [N, 4] as a camera sees them; ``turns`` [M, 4] of the moving Gaussians."""
        self._turns[self._rows] = turns
        self._shading.shade(means, self._turns, colours, camera, features)

    def shade_backward(self, means: Array, colours: Array, camera: CameraArrays, g_features: Array) -> None:
        """Turn gradients of features into those of colours, in place, and keep those of gloss and environment."""
        self._shading.shade_backward(means, self._turns, colours, camera, g_features)

    @property
    def gradients(self) -> tuple[Array, Array]:
        """Gradients of gloss and environment in the last step."""
        return self._shading.gradients

    def step(self, factor: float, smooth: bool) -> None:
        """Step both; ``smooth`` averages the changes of the gloss over neighbours afterwards."""
        self._shading.step(factor)
        if smooth:
            self._shading.smooth(self._roots)
