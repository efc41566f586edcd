"""Θ, the state of a scene: a fixed, ordered set of 3D Gaussians. Numpy only."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians at one moment. Row order is identity: row i is the same piece of matter in every frame.

    Attributes:
        means: [N, 3] float32, metres in the inside world.
        factors: [N, 3, 3] float32; Σ = F Fᵀ; the columns are the transported axes, metres.
        rotations: [N, 4] float32 unit quaternions (w, x, y, z): material rotation since frame 0.
        opacities: [N] float32 in (0, 1), fixed after frame 0.
        colours: [N, 3] float32 RGB, nominally 0…1.
        foreground: [N] float32 in 0…1: the learnt label; above 0.5 the Gaussian moves.
        ids: [N] int64, for ever.

    >>> state = Gaussians.of_points([[0, 0, 2], [0.5, 0, 2]], radius=0.1, colours=[1, 0, 0])
    >>> len(state), state.moving
    (2, array([ True,  True]))
    >>> state.replace(foreground=np.float32([1, 0])).moving
    array([ True, False])
    """

    means: Array
    factors: Array
    rotations: Array
    opacities: Array
    colours: Array
    foreground: Array
    ids: NDArray[np.int64]

    @classmethod
    def of_points(cls, points: ArrayLike, radius: float, colours: ArrayLike = 0.5) -> Gaussians:
        """Round Gaussians that move, one for each point: for scenes made by hand.

        Args:
            points: [N, 3] metres in the inside world.
            radius: metres, the standard deviation along each axis.
            colours: [N, 3] RGB in 0…1, or one for all.
        """
        means = np.array(points, np.float32).reshape(-1, 3)
        count = len(means)
        return cls(
            means=means,
            factors=np.tile(np.float32(radius) * np.eye(3, dtype=np.float32), (count, 1, 1)),
            rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
            opacities=np.full(count, 0.9, np.float32),
            colours=np.broadcast_to(np.asarray(colours, np.float32), (count, 3)).copy(),
            foreground=np.ones(count, np.float32),
            ids=np.arange(count, dtype=np.int64),
        )

    def __len__(self) -> int:
        return len(self.means)

    def replace(self, **changes: Any) -> Gaussians:
        """A copy with some of the arrays exchanged; the others are shared."""
        return replace(self, **changes)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[N] bool: the Gaussians that move, by their label."""
        moving: NDArray[np.bool_] = self.foreground > 0.5
        return moving

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays by name, for files and messages."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def quaternions_to_matrices(quaternions: NDArray[Any]) -> NDArray[Any]:
    """Unit quaternions [..., 4] (w, x, y, z) to rotation matrices [..., 3, 3].

    >>> quaternions_to_matrices(np.array([0.0, 0, 0, 1]))  # a half turn about z
    array([[-1.,  0.,  0.],
           [ 0., -1.,  0.],
           [ 0.,  0.,  1.]])
    """
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def moving_extent(gaussians: Gaussians) -> float:
    """Longest side, in metres, of the box that holds 98 % of the moving Gaussians on each axis (of all if none moves).

    It is the unit of tolerances and features that should not depend on the size of the scene; a few stray Gaussians do
    not change it.

    >>> points = np.linspace(0, 1, 101)[:, None] * [2, 1, 0]
    >>> round(moving_extent(Gaussians.of_points(points, 0.01)), 3)
    1.96
    """
    means = gaussians.means[gaussians.moving] if gaussians.moving.any() else gaussians.means
    low, high = np.percentile(means, (1, 99), axis=0)
    return float(np.max(high - low))
