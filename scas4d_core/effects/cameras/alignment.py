"""Direct photometric alignment: finds the small twist of a camera's pose that aligns a rendering with the image.

A twist consists of a translation (metres) and a rotation (radians) in camera axes. It multiplies the pose from the
left: ``world_to_camera' = exp(twist) world_to_camera``. The twist displaces the content of a pixel by ``flow``, which
changes the rendering by −gradient · flow. Gauss-Newton uses the mean gradient of image and rendering (Benhimane and
Malis 2004) and Cauchy weights. Each frame performs a single step, and later frames continue from its result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Double = NDArray[np.float64]

LOOKED_AT = 4096
"""Approximate number of sampled pixels per image, on a regular grid."""
MOST = 1000
"""Approximate maximum number of informative pixels that are used; more pixels hardly improve the estimate."""
STEEP = 0.02
"""Minimum gradient magnitude of an informative pixel, for values in [0, 1]; flatter pixels mostly show noise."""
CAUCHY = 2.4
"""Residual, as a multiple of the usual residual, at which the Cauchy weight is one half. With this value, the
estimator is 95% efficient for Gaussian noise."""
QUIETEST = 1 / 255
"""Lower bound on the usual residual, for values in [0, 1]: the quantization step of 8-bit images."""
FEW = 50
"""Minimum number of informative pixels for an estimate."""
TURNED, SHIFTED = 4.0, 0.25
"""Prior standard deviations, in pixels, of a rotation and of a translation (at the depth of the image centre). Tripods
sag or are knocked, which rotates a camera more than it translates it. Where both look alike, the prior decides between
them. With 1 pixel for translations, and a prior on each step instead of on the total, translations of 1 cm compensated
for rotations of 0.5°."""
SMALLEST = 1e-9
"""Regularization of equations that may be singular, relative to their trace."""
RESIDUAL_SCALE = 0.02
"""Residual, in [0, 1], at which ``FEW`` pixels with a gradient of 1 weigh as much as the prior."""


class AlignedPixels(NamedTuple):
    """An image and its rendering at selected pixels.

    Attributes:
        target, shown: [3, P] RGB of the image and of the rendering in [0, 1], with the camera's exposure applied.
        slopes: [3, 2, P] gradients along x and y, per pixel; see ``align_pixels``.
        places: [2, P] pixel positions u, v.
        pixels: [P] flat pixel indices in the image.
    """

    target: Array
    shown: Array
    slopes: Array
    places: Double
    pixels: NDArray[np.int64]


class Equations(NamedTuple):
    """The normal equations of one image in K unknowns.

    Attributes:
        matrix: [K, K] matrix. For unknowns ξ, the weighted squared error is ``energy − 2 vector·ξ + ξ·matrix·ξ``, in
            units of ``FEW * RESIDUAL_SCALE**2``. Translations are in units of ``depth``.
        vector: [K] right-hand side.
        energy: weighted squared error for ξ = 0.
        depth: depth of the image centre, in metres.
    """

    matrix: Double
    vector: Double
    energy: float
    depth: float


def align_pixels(target: Array, shown: Array, every: int = 1) -> AlignedPixels | None:
    """Returns an image and its rendering at informative pixels, or None if there are too few such pixels.

    Gradients of the image and the rendering are averaged, unless the rendering is subsampled.

    Args:
        target: [3, H, W] image.
        shown: [3, H, W] rendering, or [3, h, w] with only every ``every``-th row and column.
        every: stride of the rows and columns in ``shown``.
    """
    _, height, width = target.shape
    step = every * max(1, round(float(np.sqrt(height * width / LOOKED_AT))) // every)
    inner, across = np.arange(step, height - 1, step), np.arange(step, width - 1, step)
    above, rows, below = (slice(step + k, height - 1 + k, step) for k in (-1, 0, 1))
    left, columns, right = (slice(step + k, width - 1 + k, step) for k in (-1, 0, 1))
    both = [target] if every > 1 else [target, shown]
    slopes = np.zeros((3, 2, len(inner), len(across)), np.float32)
    for one in both:
        slopes[:, 0] += one[:, rows, right] - one[:, rows, left]
        slopes[:, 1] += one[:, below, columns] - one[:, above, columns]
    slopes /= np.float32(2 * len(both))
    row, column = np.nonzero(np.square(slopes).sum(axis=1).max(axis=0) > STEEP * STEEP)
    if len(row) < FEW:
        return None
    thin = -(-len(row) // MOST)
    row, column = row[::thin], column[::thin]
    v, u = inner[row], across[column]
    here = target[:, v, u], shown[:, v // every, u // every]
    return AlignedPixels(*here, slopes[:, :, row, column], np.stack([u, v]) + 0.5, v * width + u)


def flow(lens: Array | Double, places: Double, depth: Double | float = 1.0) -> Double:
    """Returns the [2, 6, ...] first-order displacement of pixels, in pixels per unit of each twist component.

    Args:
        lens: camera parameters fx, fy, cx, cy, followed by width and height, which are ignored.
        places: [2, ...] pixel positions u, v.
        depth: [...] depth along z, in the unit of the twist's translations.

    >>> flow(np.array([100, 100, 8, 8]), np.array([8.0, 8.0]), 2.0)[0]  # horizontal, for a point on the optical axis
    array([ 50.,   0.,   0.,   0., 100.,   0.])
    """
    fx, fy, cx, cy = (float(number) for number in lens[:4])
    x, y = (places[0] - cx) / fx, (places[1] - cy) / fy
    near, none = np.broadcast_to(1 / np.asarray(depth, np.float64), x.shape), np.zeros_like(x)
    across = np.stack([near, none, -x * near, -x * y, 1 + x * x, -y])
    down = np.stack([none, near, -y * near, -1 - y * y, x * y, x])
    moved: Double = np.stack([fx * across, fy * down]) + 0.0  # turns −0 into 0
    return moved


def equations(seen: AlignedPixels, moved: Double, depth: float = 1.0) -> Equations:
    """Returns the normal equations for given displacement fields.

    The weights are computed twice, because weights from the initial residuals alone would treat residuals that are
    due to a shift as outliers.

    Args:
        seen: image and rendering at the informative pixels.
        moved: [2, K, P] pixel displacements per unit of each of the K unknowns.
        depth: depth of the image centre; see ``Equations``.
    """
    residual = (seen.target - seen.shown).astype(np.float64).reshape(-1)
    slopes = seen.slopes.astype(np.float64)
    # One sum instead of an einsum, which takes five times as long for two terms.
    terms = -(slopes[:, 0] * moved[0, :, None] + slopes[:, 1] * moved[1, :, None]).reshape(moved.shape[1], -1)
    weights = _weights(residual)
    matrix = (terms * weights) @ terms.T
    way = np.linalg.solve(matrix + SMALLEST * np.trace(matrix) * np.eye(len(matrix)), (terms * weights) @ residual)
    weights = _weights(residual - way @ terms)
    weighed = terms * weights
    return Equations(weighed @ terms.T, weighed @ residual, float(weights @ np.square(residual)), depth)


def _weights(residual: Double) -> Double:
    """Returns the Cauchy weight of each residual."""
    usual = max(QUIETEST, 1.4826 * float(np.median(np.abs(residual))))
    weights: Double = (FEW * RESIDUAL_SCALE**2) ** -1 / (1 + np.square(residual / (CAUCHY * usual)))
    return weights


def twist_equations(lens: Array, seen: AlignedPixels, depth: Array) -> Equations:
    """Returns the normal equations of a twist, in six unknowns.

    Args:
        lens: camera parameters; see ``flow``.
        seen: image and rendering at the informative pixels.
        depth: [H, W] depth along z, in metres; NaN, where nothing is rendered, is replaced by the median depth.
    """
    here = depth.reshape(-1)[seen.pixels].astype(np.float64)
    known = np.isfinite(here)
    middle = float(np.median(here[known])) if known.any() else 1.0
    return equations(seen, flow(lens, seen.places, np.where(known, here, middle) / middle), middle)


def turn_equations(lens: Array, seen: AlignedPixels) -> Equations:
    """Returns the normal equations of a rotation in three unknowns, in pixels: horizontal, vertical, and roll.

    Roll is measured as the displacement of a point a quarter of the image width away from the centre. The equations do
    not depend on depth.
    """
    fx, fy, cx, cy, width = (float(number) for number in lens[:5])
    x, y = (seen.places[0] - cx) / fx, (seen.places[1] - cy) / fy
    # This is flow(lens, seen.places)[:, 3:] times turn_from_pixels(lens), without its zeros.
    across = [1 + x * x, fx / fy * x * y, -4 * fx / width * y]
    down = [fy / fx * x * y, 1 + y * y, 4 * fy / width * x]
    return equations(seen, np.stack([*across, *down]).reshape(2, 3, -1))


def turn_from_pixels(lens: Array) -> Double:
    """Returns the [3, 3] matrix that maps the unknowns of ``turn_equations`` to a rotation in radians."""
    fx, fy, width = float(lens[0]), float(lens[1]), float(lens[4])
    return np.array([[0, -1 / fy, 0], [1 / fx, 0, 0], [0, 0, 4 / width]])


def pixel_offset(lens: Array, twist: Double, depth: float) -> Double:
    """Returns the effect of a twist in pixels, [3]: horizontal and vertical displacement of the image centre, and roll.

    Args:
        lens: camera parameters fx, fy, cx, cy, width, height.
        twist: [6] twist, with its translation in metres.
        depth: depth of the image centre, in metres.
    """
    middle = np.array([lens[4] / 2, lens[5] / 2], np.float64)
    return np.append(flow(lens, middle, depth) @ twist, twist[5] * float(lens[4]) / 4)


def solve_twist(one: Equations, lens: Array, twist: Double, vector: Double | None = None) -> Double:
    """Returns the [6] increment of a twist.

    A prior keeps the total twist small if the image constrains it only weakly.

    Args:
        one: normal equations of the camera.
        lens: camera parameters; see ``flow``.
        twist: [6] current twist of the camera, with its translation in metres.
        vector: [6] right-hand side that replaces ``one.vector``, or None to use ``one.vector``.
    """
    focal, units = float(lens[0] + lens[1]) / 2, np.array([one.depth] * 3 + [1.0] * 3)
    before = np.array([(focal / SHIFTED) ** 2] * 3 + [(focal / TURNED) ** 2] * 3)
    left = (one.vector if vector is None else vector) - before * (twist / units)
    twist_of: Double = np.asarray(np.linalg.solve(one.matrix + np.diag(before), left), np.float64) * units
    return twist_of


def to_camera_twist(one: Equations, pose: Double) -> Double:
    """Returns the [6, 6] matrix that maps a twist in world axes to the unknowns of a camera's equations.

    Args:
        one: normal equations of the camera.
        pose: [4, 4] world-to-camera matrix.
    """
    return np.diag([1 / one.depth] * 3 + [1.0] * 3) @ adjoint(pose)


def adjoint(pose: Double) -> Double:
    """Returns the [6, 6] matrix that transforms a twist by a pose [4, 4], for example from world to camera axes.

    >>> beside = np.eye(4)
    >>> beside[0, 3] = 2.0  # the origin is 2 m to the right of the camera
    >>> adjoint(beside) @ [0, 0, 0, 0, 1, 0]  # a rotation about the origin rotates and translates
    array([0., 0., 2., 0., 1., 0.])
    """
    turn, matrix = pose[:3, :3], np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = turn
    matrix[:3, 3:] = _crossing(pose[:3, 3]) @ turn
    return matrix


def twist_to_matrix(twist: Double) -> Double:
    """Returns the [4, 4] matrix exponential of a twist [6].

    >>> twist_to_matrix(np.array([1.0, 2, 3, 0, 0, 0]))[:3, 3]
    array([1., 2., 3.])
    """
    motion, cross, angle = np.eye(4), _crossing(twist[3:]), float(np.linalg.norm(twist[3:]))
    small = angle < 1e-4  # series expansion, because the quotients below would lose precision
    one = 1 - angle**2 / 6 if small else np.sin(angle) / angle
    two = 0.5 - angle**2 / 24 if small else (1 - np.cos(angle)) / angle**2
    three = 1 / 6 - angle**2 / 120 if small else (1 - one) / angle**2
    motion[:3, :3] += one * cross + two * cross @ cross
    motion[:3, 3] = (np.eye(3) + two * cross + three * cross @ cross) @ twist[:3]
    return motion


def _crossing(vector: Double) -> Double:
    """Returns the [3, 3] cross-product matrix of a vector."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
