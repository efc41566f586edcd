"""Converts view-dependent colours to spherical harmonics, as used in standard splat files."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians

Float = NDArray[np.float64]

COUNT = 16
"""Number of spherical harmonics up to degree 3, the maximum degree in splat files."""
DIRECTIONS = 100
"""Number of evenly distributed directions for the integration."""
FAR_M = 1e4
"""Camera distance in metres, large enough that all Gaussians are seen from the same direction."""


def harmonics(gaussians: Gaussians) -> Float:
    """Returns the harmonic coefficients [N, 16, 3] of each Gaussian's RGB − 0.5 as a function of viewing direction.

    Directions are in world axes. The coefficients are valid only for the frame of the state, because highlights stay
    fixed in the world while objects rotate. Degree 3 is too coarse for sharp highlights, which become wider and dimmer.

    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1, colours=[0.5, 0.5, 1.0])
    >>> dull = state.replace(gloss=np.zeros((1, 3), np.float32), environment=np.zeros((259, 3), np.float32))
    >>> harmonics(dull)[0, 0].round(3) + 0
    array([0.   , 0.   , 1.772])
    """
    assert gaussians.gloss is not None
    assert gaussians.environment is not None
    from scas4d_core.engines.cpu.gloss import without_turn
    from scas4d_core.kernels.appearance.direction import shade  # only glossy states need the kernels

    place = np.arange(DIRECTIONS) + 0.5
    z, turn = 1 - 2 * place / DIRECTIONS, np.pi * (1 + 5**0.5) * place
    away = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    basis = basis_of(away)
    project = np.linalg.pinv(basis)  # exact for band-limited functions, for any distribution of directions
    coefficients = np.zeros((len(gaussians), COUNT, 3))
    shown = np.empty((len(gaussians), 4), np.float32)
    given = gaussians.means, gaussians.gloss, without_turn(len(gaussians)), gaussians.colours, gaussians.environment
    for k, direction in enumerate(away):
        shade(*given, (-FAR_M * direction).astype(np.float32), shown)
        coefficients += project[:, k][:, None] * (shown[:, None, :3] - 0.5)
    return coefficients


def basis_of(directions: NDArray[Any]) -> Float:
    """Returns the harmonics [D, 16] at unit directions [D, 3], with signs and order as in 3DGS (Kerbl et al. 2023)."""
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    columns = [
        np.full_like(x, 0.28209479177387814),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(columns, axis=1)
