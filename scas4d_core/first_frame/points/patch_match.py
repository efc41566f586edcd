"""PatchMatch stereo in Numba, which computes the depth and normal of every pixel of an image.

Each pixel stores a small plane, which is matched against several neighbouring images. Planes that
match well propagate to neighbouring pixels and are refined by random perturbation. The algorithm
follows Bleyer, Rhemann & Rother 2011 (slanted planes) and Galliani, Lasinger & Schindler 2015
(red–black order, several views). The matching cost is the weighted normalized cross-correlation of
COLMAP (Schönberger et al. 2016).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import inline, kernel, parallel_kernel

REACH = 2
"""Number of samples on either side of the centre of a patch. A patch has 5 × 5 samples."""
STEP = 2
"""Spacing of the samples in pixels. The 25 samples cover a window that is 9 pixels wide."""
TEXTURE = 0.012
"""Minimum standard deviation of a patch ([0, 1]) for a meaningful match. The value is three levels of
an 8-bit image."""
NO_MATCH = 2.0
"""Cost of a patch that cannot be compared. The cost of any other patch is 1 − NCC, between 0 and
2."""
ROUNDED = 1e-6
"""Amount by which rounding may make the cost of a perfect match negative."""

_SAMPLES = (2 * REACH + 1) ** 2


@inline
def _random(key: int, draw: int) -> float:
    """Returns a random number in [0, 1) that depends only on the arguments (splitmix64)."""
    z = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(draw) * np.uint64(0xD1B54A32D192ED03)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel
def _cost(
    patch: Any, weight: Any, mean: float, deviation: float, x: float, y: float, depth: float,
    nx: float, ny: float, nz: float, inverse: Any, rays: Any, inverses: Any, others: Any, sizes: Any, shifts: Any,
    best: int, enough: float,
) -> float:  # fmt: skip
    """Returns the cost 1 − NCC, averaged over the ``best`` neighbours that match best.

    The result is NO_MATCH if fewer neighbours see the patch, or if the cost certainly exceeds
    ``enough``. ``rays`` [V, samples, 3] is the output of ``_rays``, and ``inverses`` [samples] is a
    scratch buffer.
    """
    rx, ry = inverse[0] * x + inverse[1], inverse[2] * y + inverse[3]
    reach = depth * (nx * rx + ny * ry + nz)  # n · X of the plane's centre
    low0, low1, low2, low3 = NO_MATCH, NO_MATCH, NO_MATCH, NO_MATCH
    if abs(reach) < 1e-9:
        return NO_MATCH
    # The inverse depth at reference pixel (a, b) is (n · ray) / reach, linear in a and b.
    k = 0
    for j in range(-REACH, REACH + 1):
        qy = inverse[2] * (y + j * STEP) + inverse[3]
        for i in range(-REACH, REACH + 1):
            qx = inverse[0] * (x + i * STEP) + inverse[1]
            s = (nx * qx + ny * qy + nz) / reach
            if s <= 0.0:
                return NO_MATCH
            inverses[k] = s
            k += 1
    count = others.shape[0]
    for v in range(count):
        t = shifts[v]
        height, width = sizes[v]
        # The projection is M ray + T · (inverse depth), also linear (the homography of the plane).
        sum_w, sum_i, sum_ii, sum_ri = 0.0, 0.0, 0.0, 0.0
        inside = True
        for k in range(_SAMPLES):
            s = inverses[k]
            w3 = rays[v, k, 2] + t[2] * s
            if w3 <= 1e-6:
                inside = False
                break
            u = (rays[v, k, 0] + t[0] * s) / w3 - 0.5
            r = (rays[v, k, 1] + t[1] * s) / w3 - 0.5
            if not (u >= 0.0 and r >= 0.0 and u < width - 1.001 and r < height - 1.001):
                inside = False
                break
            c0, r0 = int(u), int(r)
            fu, fr = u - c0, r - r0
            top = others[v, r0, c0] * (1.0 - fu) + others[v, r0, c0 + 1] * fu
            low = others[v, r0 + 1, c0] * (1.0 - fu) + others[v, r0 + 1, c0 + 1] * fu
            value = top * (1.0 - fr) + low * fr
            w = weight[k]
            sum_w += w
            sum_i += w * value
            sum_ii += w * value * value
            sum_ri += w * value * patch[k]
        if inside:
            centre = sum_i / sum_w
            spread = sum_ii / sum_w - centre * centre
            if spread >= 0.25 * TEXTURE * TEXTURE:
                cost = 1.0 - (sum_ri / sum_w - centre * mean) / (deviation * np.sqrt(spread))
                if cost < low0:
                    low0, low1, low2, low3 = cost, low0, low1, low2
                elif cost < low1:
                    low1, low2, low3 = cost, low1, low2
                elif cost < low2:
                    low2, low3 = cost, low2
                elif cost < low3:
                    low3 = cost
        # Early exit: even with perfect remaining neighbours, the mean would exceed ``enough``.
        sure = best - (count - 1 - v)
        least = low0 if sure == 1 else low0 + low1 if sure == 2 else low0 + low1 + low2 if sure == 3 else 0.0
        if sure >= 1 and v < count - 1 and least - ROUNDED >= best * enough:
            return NO_MATCH
    if best == 1:
        return low0
    if best == 2:
        return 0.5 * (low0 + low1) if low1 < NO_MATCH else NO_MATCH
    return (low0 + low1 + low2) / 3.0 if low2 < NO_MATCH else NO_MATCH


@inline
def _rays(x: float, y: float, inverse: Any, matrices: Any, rays: Any) -> None:
    """Fills ``rays`` [V, samples, 3] with the rays of the samples around a pixel.

    The rays are multiplied by the matrix M of each neighbour.
    """
    for v in range(matrices.shape[0]):
        m = matrices[v]
        k = 0
        for j in range(-REACH, REACH + 1):
            qy = inverse[2] * (y + j * STEP) + inverse[3]
            for i in range(-REACH, REACH + 1):
                qx = inverse[0] * (x + i * STEP) + inverse[1]
                for axis in range(3):
                    rays[v, k, axis] = m[axis, 0] * qx + m[axis, 1] * qy + m[axis, 2]
                k += 1


@kernel
def _patch(image: Any, x: int, y: int, patch: Any, weight: Any) -> tuple[float, float]:
    """Fills ``patch`` and ``weight`` with the samples around a pixel and their bilateral weights.

    Returns:
        Weighted mean and standard deviation of the samples.
    """
    height, width = image.shape
    middle = image[y, x]
    sum_w, sum_i, sum_ii = 0.0, 0.0, 0.0
    k = 0
    for j in range(-REACH, REACH + 1):
        b = min(max(y + j * STEP, 0), height - 1)
        for i in range(-REACH, REACH + 1):
            a = min(max(x + i * STEP, 0), width - 1)
            value = image[b, a]
            w = np.exp(-abs(value - middle) / 0.2 - (i * i + j * j) / (2.0 * REACH * REACH))
            patch[k], weight[k] = value, w
            sum_w += w
            sum_i += w * value
            sum_ii += w * value * value
            k += 1
    mean = sum_i / sum_w
    return mean, np.sqrt(max(sum_ii / sum_w - mean * mean, 0.0))


@parallel_kernel
def _sweep(
    image: Any, active: Any, prior: Any, depth: Any, normal: Any, cost: Any, inverse: Any, others: Any, sizes: Any,
    matrices: Any, shifts: Any, near: float, far: float, round_: int, colour: int, best: int, seed: int,
) -> None:  # fmt: skip
    """Runs one round over the pixels of one checkerboard colour.

    Round 0 initializes the planes of all pixels.
    """
    height, width = image.shape
    for y in prange(height):
        patch, weight, inverses = np.empty(_SAMPLES), np.empty(_SAMPLES), np.empty(_SAMPLES)
        rays = np.empty((others.shape[0], _SAMPLES, 3))
        for x in range(width):
            if not active[y, x] or (round_ > 0 and (x + y) % 2 != colour):
                continue
            mean, deviation = _patch(image, x, y, patch, weight)
            if deviation < TEXTURE:
                cost[y, x] = NO_MATCH
                continue
            key = ((seed * 64 + round_) * height + y) * width + x + 1
            px, py = x + 0.5, y + 0.5
            _rays(px, py, inverse, matrices, rays)
            d, c = depth[y, x], cost[y, x]
            nx, ny, nz = normal[y, x, 0], normal[y, x, 1], normal[y, x, 2]
            tries = 3 if round_ == 0 else 8 + 4
            for attempt in range(tries):
                td, tx, ty, tz = d, nx, ny, nz
                if round_ == 0:
                    td = 1.0 / (1.0 / far + _random(key, 8 * attempt) * (1.0 / near - 1.0 / far))
                    if attempt > 0 and prior[y, x] > 0.0:
                        td = prior[y, x]
                    # The random normal is within 60 degrees of the direction to the camera.
                    angle, tilt = 6.2831853 * _random(key, 8 * attempt + 1), np.sqrt(_random(key, 8 * attempt + 2))
                    sine = 0.86 * tilt
                    tx, ty, tz = sine * np.cos(angle), sine * np.sin(angle), -np.sqrt(1.0 - sine * sine)
                elif attempt < 8:
                    span = 1 if attempt < 4 else 3 + 2 * (round_ % 3)
                    side = attempt % 4
                    a = x + (span if side == 0 else -span if side == 1 else 0)
                    b = y + (span if side == 2 else -span if side == 3 else 0)
                    if a < 0 or b < 0 or a >= width or b >= height or cost[b, a] >= NO_MATCH:
                        continue
                    # Intersect the plane of the neighbouring pixel with the ray of this pixel.
                    tx, ty, tz = normal[b, a, 0], normal[b, a, 1], normal[b, a, 2]
                    there = tx * (inverse[0] * (a + 0.5) + inverse[1]) + ty * (inverse[2] * (b + 0.5) + inverse[3]) + tz
                    here = tx * (inverse[0] * px + inverse[1]) + ty * (inverse[2] * py + inverse[3]) + tz
                    if abs(here) < 1e-6:
                        continue
                    td = depth[b, a] * there / here
                else:
                    scale = 0.5 ** (round_ + 2 * (attempt - 8))
                    step = 0.25 * scale * (1.0 / near - 1.0 / far)
                    td = 1.0 / (1.0 / d + step * (2.0 * _random(key, 8 * attempt) - 1.0))
                    tx += scale * (2.0 * _random(key, 8 * attempt + 1) - 1.0)
                    ty += scale * (2.0 * _random(key, 8 * attempt + 2) - 1.0)
                    tz += scale * (2.0 * _random(key, 8 * attempt + 3) - 1.0)
                    length = np.sqrt(tx * tx + ty * ty + tz * tz)
                    if length < 1e-3:
                        continue
                    tx, ty, tz = tx / length, ty / length, tz / length
                facing = tx * (inverse[0] * px + inverse[1]) + ty * (inverse[2] * py + inverse[3]) + tz
                if not (td >= near and td <= far) or facing > -0.15:
                    continue
                tc = _cost(
                    patch, weight, mean, deviation, px, py, td, tx, ty, tz,
                    inverse, rays, inverses, others, sizes, shifts, best, c,
                )  # fmt: skip
                if tc < c:
                    d, c, nx, ny, nz = td, tc, tx, ty, tz
            depth[y, x], cost[y, x] = d, c
            normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = nx, ny, nz


def patch_match(
    image: Any, active: Any, prior: Any, inverse: Any, others: Any, sizes: Any, matrices: Any, shifts: Any,
    *, near: float, far: float, iterations: int, best: int, seed: int,
) -> tuple[Any, Any, Any]:  # fmt: skip
    """Computes the depth and normal of each pixel of an image.

    Args:
        image: [H, W] float32 grayscale in [0, 1].
        active: [H, W] bool, pixels to compute.
        prior: [H, W] float64 depth to try first, or 0 if there is none.
        inverse: [4] float64 inverse intrinsics (1/fx, −cx/fx, 1/fy, −cy/fy).
        others: [V, H', W'] float32 images of the neighbours, each in the upper left corner of its plane.
        sizes: [V, 2] int64 height and width of each neighbour's image.
        matrices: [V, 3, 3] float64 K' R of each neighbour, where R rotates from the axes of the reference camera.
        shifts: [V, 3] float64 K' t of each neighbour.
        near: minimum depth, in world units.
        far: maximum depth, in world units.
        iterations: number of rounds.
        best: number of neighbours that must match well, 1 to 3.
        seed: random seed for sampling planes.

    Returns:
        Depths [H, W] float64 (0 if there is no match), normals [H, W, 3] in camera axes, and costs 1 − NCC [H, W].
    """
    height, width = image.shape
    depth, cost = np.zeros((height, width)), np.full((height, width), NO_MATCH)
    normal = np.zeros((height, width, 3))
    normal[..., 2] = -1.0
    for round_ in range(iterations + 1):
        for colour in range(2 if round_ else 1):
            _sweep(
                image, active, prior, depth, normal, cost, inverse, others, sizes, matrices, shifts,
                near, far, round_, colour, best, seed,
            )  # fmt: skip
    depth[cost >= NO_MATCH] = 0.0
    return depth, normal, cost
