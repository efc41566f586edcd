"""The start of an update: the previous deformation goes on (paper, Optimization Pipeline)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scas4d_core.deformation_cpu import CpuDeformation
from scas4d_core.settings import UpdateSettings

Array = NDArray[np.float32]


def quaternion_products(a: Array, b: Array) -> Array:
    """[M, 4] a∘b (w, x, y, z): first b, then a."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    )


def quaternion_rotate(r: Array, vectors: Array) -> Array:
    """[K, 3] vectors turned by the quaternions (1, r)/|(1, r)|, r [K, 3]."""
    cross = np.cross(r, vectors)
    return vectors + 2 * (cross + np.cross(r, cross)) / (1 + np.square(r).sum(axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Motion:
    """A deformation that was found, to start the next from.

    Attributes:
        clusters: per layer [K, 10]. deltas: [M, 9]. seconds: it took.
    """

    clusters: list[Array]
    deltas: Array
    seconds: float

    @classmethod
    def of(cls, deformation: CpuDeformation, seconds: float) -> Motion:
        """What a deformation holds now."""
        return cls([values.copy() for values in deformation.clusters], deformation.deltas.copy(), seconds)


def warm_start(deformation: CpuDeformation, motion: Motion | None, seconds: float, settings: UpdateSettings) -> None:
    """Set the parameters to the previous motion, per unit of time; scaling (c, s) and Δs start at the identity.

    A cluster that turns carries its displacement along: a pivot on a circle goes on along the circle.
    """
    share = 0.0 if motion is None else settings.warm_start * seconds / motion.seconds
    for k, values in enumerate(deformation.clusters):
        values[:] = 0
        if motion is not None:
            r, t = motion.clusters[k][:, :3], motion.clusters[k][:, 3:6]
            values[:, :3] = share * r
            values[:, 3:6] = share * quaternion_rotate(share * r, t)
    deformation.deltas[:] = 0
    if motion is not None and settings.momentum:
        deformation.deltas[:, :6] = share * motion.deltas[:, :6]
