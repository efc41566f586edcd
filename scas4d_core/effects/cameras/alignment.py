"""Direct photometric alignment: the small twist of a camera's pose that brings a rendering onto its picture.

A twist is six numbers in the camera's axes, shift (metres) and turn (radians), applied on the left of its pose:
``world_to_camera' = exp(twist) world_to_camera``. By it what is seen at a pixel moves by ``flow``, and the rendering
changes by −slope · flow: Gauss-Newton, with the mean slope of picture and rendering (Benhimane and Malis 2004) and
Cauchy's weights. One step is taken of a frame: the next frame goes on.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Double = NDArray[np.float64]

LOOKED_AT = 4096
"""Pixels of a picture that are looked at, about: rows and columns apart."""
MOST = 1000
"""Share of the informative pixels that are used, about: more pixels of a room add nothing that objects do not show."""
STEEP = 0.02
"""Length of the slope, of a value 0…1 a pixel, from which a pixel shows a shift: flatter pixels show noise."""
CAUCHY = 2.4
"""Times the usual residual, at which a pixel has half of its weight (95 % efficient under Gaussian noise)."""
QUIETEST = 1 / 255
"""Residual, 0…1, that is usual at least: the rounding of pictures."""
FEW = 50
"""Informative pixels that a shift needs at least."""
TURNED, SHIFTED = 4.0, 0.25
"""Pixels that a turn, and a shift at the depth of the picture's middle, are thought to move it by before anything is
seen: tripods sag and are knocked, which turns a camera rather than shifts it. It decides where the two look alike: with
1 pixel of shift, and a prior for each step instead of for all, turns of 0.5° were undone by shifts of 1 cm."""
SMALLEST = 1e-9
"""Of the trace, added to equations that may have no solution."""
RESIDUAL_SCALE = 0.02
"""Residual, 0…1, at which ``FEW`` pixels with a slope of 1 weigh as much as what is thought before."""


class AlignedPixels(NamedTuple):
    """A picture and its rendering, at some pixels.

    Attributes:
        target, shown: [3, P] RGB in 0…1, with the exposure of the camera. slopes: [3, 2, P] a pixel, along x and y.
        places: [2, P] positions u, v of the pixels. pixels: [P] which they are, of the picture's.
    """

    target: Array
    shown: Array
    slopes: Array
    places: Double
    pixels: NDArray[np.int64]


class Equations(NamedTuple):
    """The normal equations of one picture, in K numbers.

    Attributes:
        matrix: [K, K], vector: [K]; a twist ξ leaves the weighted squares ``energy − 2 vector·ξ + ξ·matrix·ξ``, in
            units of ``RESIDUAL_SCALE``. Shifts are in units of ``depth``. energy: those of the residual as it is.
        depth: metres, of the picture's middle.
    """

    matrix: Double
    vector: Double
    energy: float
    depth: float


def align_pixels(target: Array, shown: Array, every: int = 1) -> AlignedPixels | None:
    """Both at the informative pixels among those that are looked at; None: there are too few.

    Args:
        target: [3, H, W]. shown: [3, H, W], or [3, h, w] where it is thinned to every so many rows and columns, and the
            slopes are those of the target alone.
    """
    _, height, width = target.shape
    step = every * max(1, round(float(np.sqrt(height * width / LOOKED_AT))) // every)
    inner, across = np.arange(step, height - 1, step), np.arange(step, width - 1, step)
    rows, columns = inner[:, None], across[None, :]
    both = [target] if every > 1 else [target, shown]
    twice = [
        np.stack(
            [
                one[:, rows, columns + 1] - one[:, rows, columns - 1],
                one[:, rows + 1, columns] - one[:, rows - 1, columns],
            ],
            axis=1,
        )
        for one in both
    ]
    slopes: Array = (np.sum(twice, axis=0) / (2 * len(both))).astype(np.float32)
    row, column = np.nonzero(np.square(slopes).sum(axis=1).max(axis=0) > STEEP * STEEP)
    if len(row) < FEW:
        return None
    thin = -(-len(row) // MOST)
    row, column = row[::thin], column[::thin]
    v, u = inner[row], across[column]
    here = target[:, v, u], shown[:, v // every, u // every]
    return AlignedPixels(*here, slopes[:, :, row, column], np.stack([u, v]) + 0.5, v * width + u)


def flow(lens: Array | Double, places: Double, depth: Double | float = 1.0) -> Double:
    """[2, 6, ...] pixels that each number of a twist moves what is seen at some places, to first order.

    Args:
        lens: fx, fy, cx, cy, … places: [2, ...] u, v. depth: [...] along z; shifts of the twist are in the same unit.

    >>> flow(np.array([100, 100, 8, 8]), np.array([8.0, 8.0]), 2.0)[0]  # across, of what lies on the axis
    array([ 50.,   0.,   0.,   0., 100.,   0.])
    """
    fx, fy, cx, cy = (float(number) for number in lens[:4])
    x, y = (places[0] - cx) / fx, (places[1] - cy) / fy
    near, none = np.broadcast_to(1 / np.asarray(depth, np.float64), x.shape), np.zeros_like(x)
    across = np.stack([near, none, -x * near, -x * y, 1 + x * x, -y])
    down = np.stack([none, near, -y * near, -1 - y * y, x * y, x])
    moved: Double = np.stack([fx * across, fy * down]) + 0.0  # no minus before a 0
    return moved


def equations(seen: AlignedPixels, moved: Double, depth: float = 1.0) -> Equations:
    """The normal equations of what moves the pixels.

    They are weighed twice: with the residual as it is, what a shift explains would pass for things in the way.

    Args:
        moved: [2, K, P] pixels that each of K numbers moves them by. depth: see ``Equations``.
    """
    residual = (seen.target - seen.shown).astype(np.float64).reshape(-1)
    terms = -np.einsum("cdp,dkp->kcp", seen.slopes.astype(np.float64), moved).reshape(moved.shape[1], -1)
    weights = _weights(residual)
    matrix = (terms * weights) @ terms.T
    way = np.linalg.solve(matrix + SMALLEST * np.trace(matrix) * np.eye(len(matrix)), (terms * weights) @ residual)
    weights = _weights(residual - way @ terms)
    weighed = terms * weights
    return Equations(weighed @ terms.T, weighed @ residual, float(weights @ np.square(residual)), depth)


def _weights(residual: Double) -> Double:
    """Of each residual."""
    usual = max(QUIETEST, 1.4826 * float(np.median(np.abs(residual))))
    weights: Double = (FEW * RESIDUAL_SCALE**2) ** -1 / (1 + np.square(residual / (CAUCHY * usual)))
    return weights


def twist_equations(lens: Array, seen: AlignedPixels, depth: Array) -> Equations:
    """Those of a twist, six numbers.

    Args:
        lens: of the camera. depth: [H, W] metres along z; NaN where nothing is seen, taken for the middle's.
    """
    here = depth.reshape(-1)[seen.pixels].astype(np.float64)
    known = np.isfinite(here)
    middle = float(np.median(here[known])) if known.any() else 1.0
    return equations(seen, flow(lens, seen.places, np.where(known, here, middle) / middle), middle)


def turn_equations(lens: Array, seen: AlignedPixels) -> Equations:
    """Those of a turn, three numbers in pixels: across, down, and round by so many at a quarter of the width.

    They hang on no depth.
    """
    return equations(seen, np.einsum("dkp,kl->dlp", flow(lens, seen.places)[:, 3:], turn_from_pixels(lens)))


def turn_from_pixels(lens: Array) -> Double:
    """[3, 3] the turn, radians, for each of the three numbers of ``turn_equations``."""
    fx, fy, width = float(lens[0]), float(lens[1]), float(lens[4])
    return np.array([[0, -1 / fy, 0], [1 / fx, 0, 0], [0, 0, 4 / width]])


def pixel_offset(lens: Array, twist: Double, depth: float) -> Double:
    """[3] pixels across, down and round by which a twist moves the middle of a picture.

    Args:
        depth: metres, of the middle.
    """
    middle = np.array([lens[4] / 2, lens[5] / 2], np.float64)
    return np.append(flow(lens, middle, depth) @ twist, twist[5] * float(lens[4]) / 4)


def solve_twist(one: Equations, lens: Array, twist: Double, vector: Double | None = None) -> Double:
    """[6] the twist beside one that a camera has already, shift in metres; their sum is small where little is seen.

    Args:
        twist: [6] that it has. vector: in the place of the equations' own.
    """
    focal, units = float(lens[0] + lens[1]) / 2, np.array([one.depth] * 3 + [1.0] * 3)
    before = np.array([(focal / SHIFTED) ** 2] * 3 + [(focal / TURNED) ** 2] * 3)
    left = (one.vector if vector is None else vector) - before * (twist / units)
    twist_of: Double = np.asarray(np.linalg.solve(one.matrix + np.diag(before), left), np.float64) * units
    return twist_of


def to_camera_twist(one: Equations, pose: Double) -> Double:
    """[6, 6] a twist of the world's axes, in the numbers of a camera's equations.

    Args:
        pose: [4, 4] world to camera.
    """
    return np.diag([1 / one.depth] * 3 + [1.0] * 3) @ adjoint(pose)


def adjoint(pose: Double) -> Double:
    """[6, 6] a twist in the axes before a pose [4, 4], as it is in the axes after.

    >>> beside = np.eye(4)
    >>> beside[0, 3] = 2.0  # the origin is seen 2 m to the right
    >>> adjoint(beside) @ [0, 0, 0, 0, 1, 0]  # a turn about the origin turns and shifts
    array([0., 0., 2., 0., 1., 0.])
    """
    turn, matrix = pose[:3, :3], np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = turn
    matrix[:3, 3:] = _crossing(pose[:3, 3]) @ turn
    return matrix


def twist_to_matrix(twist: Double) -> Double:
    """[4, 4] the exponential of a twist [6].

    >>> twist_to_matrix(np.array([1.0, 2, 3, 0, 0, 0]))[:3, 3]
    array([1., 2., 3.])
    """
    motion, cross, angle = np.eye(4), _crossing(twist[3:]), float(np.linalg.norm(twist[3:]))
    small = angle < 1e-4  # series: the quotients below would lose their digits
    one = 1 - angle**2 / 6 if small else np.sin(angle) / angle
    two = 0.5 - angle**2 / 24 if small else (1 - np.cos(angle)) / angle**2
    three = 1 / 6 - angle**2 / 120 if small else (1 - one) / angle**2
    motion[:3, :3] += one * cross + two * cross @ cross
    motion[:3, 3] = (np.eye(3) + two * cross + three * cross @ cross) @ twist[:3]
    return motion


def _crossing(vector: Double) -> Double:
    """[3, 3] the cross product with a vector on the left."""
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
