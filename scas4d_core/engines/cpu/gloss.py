"""View-dependent colours, and optimization of the gloss and environment that produce them.

The formula is in ``kernels.appearance.direction``, which is only imported if a scene is glossy.
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
"""Initial gloss strength of a Gaussian. Only the product of strength and environment is visible. The strengths of
equally glossy Gaussians therefore stay near this value, and the environment absorbs the rest."""
RATE_GLOSS, RATE_ENVIRONMENT, RATE_NEARNESS = 1e-3, 2e-2, 5e-3
"""Adam learning rates in frame 0. The gloss rate applies at a strength of ``GLOSS``; see ``gloss_rate``. With higher
gloss rates, individual Gaussians overfit a single camera's highlight. On the `gloss` scene, rates of 5e-3 for strengths
and 3e-3 for normals reduced the PSNR of test views by 0.6 dB."""
UPDATE_RATE_GLOSS, UPDATE_RATE_ENVIRONMENT, UPDATE_RATE_NEARNESS = 2e-3, 1e-2, 1e-3
"""Initial Adam learning rates of an update. They decay to a tenth of these values during the update."""
NEARNESS = 0.3
"""Initial nearness (inverse distance) of the environment in 1/m, typical of lights in a room."""
NEIGHBOURS = 16
"""Number of neighbours over which changes of normals and strengths are averaged, because surfaces curve gradually."""
SAME_SIDE = 0.5
"""Cosine between normals above which neighbours are considered part of the same surface."""


def without_turn(count: int) -> Array:
    """Returns [count, 4] identity quaternions."""
    turns = np.zeros((count, 4), np.float32)
    turns[:, 0] = 1
    return turns


def features_seen(gaussians: Gaussians, camera: CameraArrays, turns: Array | None = None) -> Array:
    """Returns the features [N, 4] of a state (RGB and label) as seen by a camera. See ``colours_seen``."""
    return gaussians.features(colours_seen(gaussians, camera, turns))


def colours_seen(gaussians: Gaussians, camera: CameraArrays, turns: Array | None = None) -> Array:
    """Returns the colours [N, 3] of a state as seen by a camera. Without gloss, returns ``gaussians.colours`` itself.

    Args:
        gaussians: state to shade.
        camera: camera in kernel format.
        turns: [N, 4] rotations of the Gaussians since their gloss was stored, as unit quaternions, or None if they have
            not rotated.
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
    """Returns the gloss learning rate at which normals rotate as fast as at strength ``GLOSS`` with the given rate.

    Adam's step length does not depend on the strength. At a fifth of the strength, normals would therefore rotate five
    times as fast. In a test on the `gloss` scene, this reduced the PSNR of frame 0 by 0.6 dB. The rate is scaled by the
    mean strength, weighted by the strengths themselves, because Gaussians without gloss have no normal.

    Args:
        rate: learning rate at strength ``GLOSS``.
        gloss: [M, 3] normal of each Gaussian, scaled by its strength.

    >>> gloss_rate(1e-3, np.array([[0.1, 0, 0], [0, 0, 0.1], [0, 0, 0]], np.float32))
    0.0002
    """
    strengths = np.linalg.norm(gloss.astype(np.float64), axis=1)
    typical = float(np.square(strengths).sum() / max(strengths.sum(), 1e-9))
    return round(rate * typical / float(GLOSS), 9)


class GlossShading:
    """Gloss and environment parameters, with their gradients and optimizer state.

    Args:
        gloss: [M, 3] normal of each Gaussian, scaled by its gloss strength. It is updated in place.
        environment: [ROWS, 3] environment, updated in place.
        rates: learning rates of the gloss, the environment and its nearness.

    Attributes:
        gloss, environment, rates: same as the arguments.
        moments: Adam moments of the gloss and environment, [2, …] each.
        steps: number of Adam steps so far.
        changed_from: [M, 3] reference gloss. ``smooth`` averages the changes since this reference.
        gradients: gradients of the gloss and environment, accumulated since the last step.
    """

    def __init__(self, gloss: Array, environment: Array, rates: tuple[float, float, float]) -> None:
        from scas4d_core.kernels.appearance import direction

        self._kernel = direction
        self.gloss, self.environment = gloss, environment
        self.changed_from, self.rates = gloss.copy(), rates
        self._turned = np.empty_like(gloss)
        self.gradients = np.zeros_like(gloss), np.zeros_like(environment)
        self.moments = [np.zeros((2, *table.shape), np.float32) for table in (gloss, environment)]
        self._columns = np.array([rates[0]] * 3, np.float32)
        self._by_row = environment_rates(rates)
        self._cells = cell_areas(direction.SIDE)
        self._seen = self.steps = 0
        self._near: tuple[Any, Any] | None = None

    @classmethod
    def fresh(cls, gloss: Array, means: Array, environment: Array | None = None) -> GlossShading:
        """Creates parameters with zero moments for frame 0.

        Args:
            gloss: [M, 3] normal of each Gaussian, scaled by its gloss strength.
            means: [N, 3] means in metres, which determine the centre of a new environment.
            environment: [ROWS, 3] environment, or None for a new environment without light.
        """
        from scas4d_core.kernels.appearance import direction

        if environment is None:
            environment = np.zeros((direction.ROWS, 3), np.float32)
            environment[direction.MIDDLE] = np.median(means, axis=0)
            environment[direction.NEARNESS, 0] = NEARNESS
        return cls(gloss, environment, (gloss_rate(RATE_GLOSS, gloss), RATE_ENVIRONMENT, RATE_NEARNESS))

    def shade(self, means: Array, turns: Array, colours: Array, camera: CameraArrays, features: Array) -> None:
        """Fills the RGB channels of ``features`` [N, 4] with the colours that a camera sees."""
        self._kernel.shade(means, self.gloss, turns, colours, self.environment, camera.centre, features)

    def shade_backward(
        self, means: Array, turns: Array, colours: Array, camera: CameraArrays, g_features: Array
    ) -> None:
        """Converts feature gradients to colour gradients in place, and accumulates gloss and environment gradients."""
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
        """Takes an Adam step with the mean gradient since the last step.

        Afterwards, the environment is shifted to zero mean over the sphere, and its nearness is clamped to at least 0.
        """
        from scas4d_core.kernels.adam import EVERY_ROW, adam

        self.steps += 1
        beta1, beta2 = np.float32(0.9), np.float32(0.999)
        ones = np.full(3, factor, np.float32)
        for table, gradient, moments, columns, by_row in (
            (self.gloss, self.gradients[0], self.moments[0], self._columns * np.float32(factor), EVERY_ROW),
            (self.environment, self.gradients[1], self.moments[1], ones, self._by_row),
        ):
            gradient /= np.float32(max(self._seen, 1))
            adam(table, gradient, moments[0], moments[1], columns, by_row, beta1, beta2, self.steps)
        self._seen = 0
        cells = self.environment[: self._kernel.CELLS]
        cells -= (self._cells[:, None] * cells).sum(axis=0)
        nearness = self.environment[self._kernel.NEARNESS]
        np.clip(nearness, 0, None, out=nearness)

    def select_rows(self, rows: NDArray[np.int64], parents: NDArray[np.int64]) -> GlossShading:
        """Returns the gloss and moments of ``rows``, followed by copies of ``parents`` with zero moments."""
        every = np.concatenate([rows, parents])
        chosen = GlossShading(self.gloss[every], self.environment, self.rates)
        moments = self.moments[0][:, every]
        moments[:, len(rows) :] = 0
        chosen.moments = [np.ascontiguousarray(moments), self.moments[1]]
        chosen.changed_from, chosen.steps = self.changed_from[every], self.steps
        return chosen

    def smooth(self, means: Array) -> None:
        """Averages the changes since ``changed_from`` over neighbours on the same side of a surface.

        Args:
            means: [N, 3] positions, from which the neighbours are determined on the first call.
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


def environment_rates(rates: tuple[float, float, float]) -> Array:
    """Returns the learning rate [ROWS] of each row of an environment. The scene centre x₀ is not learned.

    Args:
        rates: learning rates of the gloss, the environment and its nearness.
    """
    from scas4d_core.kernels.appearance import direction

    by_row = np.full(direction.ROWS, rates[1], np.float32)
    by_row[direction.MIDDLE], by_row[direction.NEARNESS] = 0, rates[2]
    return by_row


def cell_areas(side: int) -> Array:
    """Returns the fraction [side²] of the sphere covered by each cell of an octahedral map. The fractions sum to 1."""
    u, v = np.meshgrid(*[np.linspace(-1, 1, side)] * 2)
    x, y, z = u, v, 1 - abs(u) - abs(v)
    # The solid angle of a map element is proportional to 1/|p|³; cells on the border are cut in half.
    fold = z < 0
    x, y = np.where(fold, (1 - abs(v)) * np.sign(u), u), np.where(fold, (1 - abs(u)) * np.sign(v), v)
    area = (x * x + y * y + z * z) ** -1.5
    area[[0, -1]] /= 2
    area[:, [0, -1]] /= 2
    shares: Array = (area / area.sum()).astype(np.float32).ravel()
    return shares


class LearntGloss:
    """Gloss and environment parameters of an attempt. The normals rotate with the deformation.

    Args:
        gloss: gloss of Θ_{t−1}, relative to the orientation in Θ_{t−1}.
        environment: environment of Θ_{t−1}.
        count: number of Gaussians, N.
        rows: [M] rows of the moving Gaussians.
        roots: [N, 3] positions in frame 0, in metres, used to find neighbours.
    """

    def __init__(self, gloss: Array, environment: Array, count: int, rows: NDArray[np.int64], roots: Array) -> None:
        rates = (gloss_rate(UPDATE_RATE_GLOSS, gloss), UPDATE_RATE_ENVIRONMENT, UPDATE_RATE_NEARNESS)
        self._shading = GlossShading(gloss.copy(), environment.copy(), rates)
        self._turns, self._rows, self._roots = without_turn(count), rows, roots

    @property
    def gloss(self) -> Array:
        """Current gloss [M, 3], relative to the orientation in Θ_{t−1}."""
        return self._shading.gloss

    @property
    def environment(self) -> Array:
        """Current environment."""
        return self._shading.environment

    def shade(self, means: Array, turns: Array, colours: Array, camera: CameraArrays, features: Array) -> None:
        """Fills the RGB channels of ``features`` [N, 4], given the rotations ``turns`` [M, 4] of moving Gaussians."""
        self._turns[self._rows] = turns
        self._shading.shade(means, self._turns, colours, camera, features)

    def shade_backward(self, means: Array, colours: Array, camera: CameraArrays, g_features: Array) -> None:
        """Converts feature gradients to colour gradients in place, and accumulates gloss and environment gradients."""
        self._shading.shade_backward(means, self._turns, colours, camera, g_features)

    @property
    def gradients(self) -> tuple[Array, Array]:
        """Gradients of the gloss and environment in the last step."""
        return self._shading.gradients

    def step(self, factor: float, smooth: bool) -> None:
        """Takes an Adam step. If ``smooth`` is true, gloss changes are then averaged over neighbours."""
        self._shading.step(factor)
        if smooth:
            self._shading.smooth(self._roots)
