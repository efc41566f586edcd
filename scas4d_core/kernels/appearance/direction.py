"""View-dependent colours of glossy Gaussians that reflect an environment, and their backward pass.

Light is additive, and pixel values are approximately its square root (a gamma of 2). Let c be the colour of a Gaussian,
s its gloss, n its normal, v the direction to the camera, μ = n·v, and r = 2μn − v the reflected direction. For μ > 0:

    T = c|c| (1 − FALL f min(s, 1)) + s (E(r + k (x − x₀)) + sheen f),    f = (1 − μ)⁴,    colour = T / √|T|

E is the environment, an RGB grid over directions (octahedral map, Cigolle et al. 2014) that is
sampled bilinearly. The environment stays fixed in the world while objects rotate. The direction to
a nearby light depends on the position x of the Gaussian. The lookup therefore uses the inverse
distance k of the light and the centre x₀ of the scene. The sheen is the reflection at grazing
angles, where diffuse light decreases.

The reference implementation is ``engines.torch.gloss``. Gradients with respect to positions and
rotations are omitted. The direction to a camera hardly changes during an update, and texture and
silhouettes determine rotations.
"""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from scas4d_core.kernels.jit import ONE, TWO, ZERO, parallel_kernel

SIDE = 16
"""Number of cells along a side of the grid. A cell covers 12 degrees, about the width of the
highlight of a lamp on a glazed surface."""
CELLS = SIDE * SIDE
SHEEN, MIDDLE, NEARNESS = CELLS, CELLS + 1, CELLS + 2
"""Indices of the environment rows that follow the cells: sheen (RGB), x₀, and (k, 0, 0)."""
ROWS = CELLS + 3
FALL = np.float32(0.9)
"""Fraction of the diffuse light that is lost at grazing angles."""
DARK = np.float32(1e-4)
"""Light level below which the square root is replaced by a linear function, because its slope is unbounded at 0."""
OVER = np.float32(0.05)
"""Slope of colours above 1. Images saturate at white, but a small gradient still allows colours to become darker."""
DULL = np.float32(1e-4)
"""Gloss strength below which a Gaussian has no normal and its colour does not depend on the view."""
CHUNK = 4096
_STEP = np.float32((SIDE - 1) / 2)
_LAST = SIDE - 2
_FOUR = np.float32(4)


def shade(
    means: NDArray[np.float32],
    gloss: NDArray[np.float32],
    turns: NDArray[np.float32],
    colours: NDArray[np.float32],
    environment: NDArray[np.float32],
    centre: NDArray[np.float32],
    shown: NDArray[np.float32],
) -> None:
    """Fills the first three columns of ``shown`` [N, 4] with the colours that a camera sees.

    Args:
        means: [N, 3] means, in metres.
        gloss: [M, 3] unrotated normals of the first M ≤ N Gaussians, scaled by gloss strength. All other Gaussians are
            not glossy.
        turns: [N, 4] rotations of the normals, as unit quaternions (w, x, y, z).
        colours: [N, 3] RGB colours without gloss.
        environment: [ROWS, 3] environment.
        centre: [3] camera centre, in metres.
        shown: [N, 4] output.
    """
    shade_rows(means, gloss, turns, colours, environment, centre, shown)


def shade_backward(
    means: NDArray[np.float32],
    gloss: NDArray[np.float32],
    turns: NDArray[np.float32],
    colours: NDArray[np.float32],
    environment: NDArray[np.float32],
    centre: NDArray[np.float32],
    g_shown: NDArray[np.float32],
    g_gloss: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Backpropagates through ``shade``.

    Args:
        means, gloss, turns, colours, environment, centre: see ``shade``.
        g_shown: [N, 4] gradient of ``shown``. The gradient of ``colours`` replaces the first three
            columns.
        g_gloss: [M, 3] output, gradient of ``gloss``.

    Returns:
        [ROWS, 3] gradient of the environment. The row of x₀ is 0.
    """
    sums = np.zeros((-(-len(means) // CHUNK), ROWS, 3), np.float32)
    shade_rows_backward(means, gloss, turns, colours, environment, centre, g_shown, g_gloss, sums)
    total: NDArray[np.float32] = sums.sum(axis=0)
    return total


@parallel_kernel
def shade_rows(means, gloss, turns, colours, environment, centre, shown):
    """Implements ``shade`` with parallel tasks."""
    count, glossy = means.shape[0], gloss.shape[0]
    k = environment[NEARNESS, 0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            for c in range(3):
                shown[i, c] = colours[i, c]
            if i >= glossy:
                continue
            w, x, y, z = turns[i, 0], turns[i, 1], turns[i, 2], turns[i, 3]
            a, b, d = gloss[i, 0], gloss[i, 1], gloss[i, 2]
            s = np.float32(np.sqrt(a * a + b * b + d * d))
            if not s > DULL:
                continue
            tx, ty, tz = TWO * (y * d - z * b), TWO * (z * a - x * d), TWO * (x * b - y * a)
            nx = (a + w * tx + y * tz - z * ty) / s
            ny = (b + w * ty + z * tx - x * tz) / s
            nz = (d + w * tz + x * ty - y * tx) / s
            vx, vy, vz = centre[0] - means[i, 0], centre[1] - means[i, 1], centre[2] - means[i, 2]
            far = np.float32(np.sqrt(vx * vx + vy * vy + vz * vz))
            vx, vy, vz = vx / far, vy / far, vz / far
            mu = nx * vx + ny * vy + nz * vz
            if not mu > ZERO:
                continue
            px = TWO * mu * nx - vx + k * (means[i, 0] - environment[MIDDLE, 0])
            py = TWO * mu * ny - vy + k * (means[i, 1] - environment[MIDDLE, 1])
            pz = TWO * mu * nz - vz + k * (means[i, 2] - environment[MIDDLE, 2])
            length = abs(px) + abs(py) + abs(pz)
            if not length > ZERO:
                continue
            ox, oy = px / length, py / length
            gu = ox if pz >= ZERO else (ONE - abs(oy)) * (ONE if ox >= ZERO else -ONE)
            gv = oy if pz >= ZERO else (ONE - abs(ox)) * (ONE if oy >= ZERO else -ONE)
            fu, fv = (gu + ONE) * _STEP, (gv + ONE) * _STEP
            iu, iv = min(max(int(fu), 0), _LAST), min(max(int(fv), 0), _LAST)
            fu, fv = fu - np.float32(iu), fv - np.float32(iv)
            cell = iv * SIDE + iu
            away = ONE - mu
            f = away * away * away * away
            left = ONE - FALL * f * min(s, ONE)
            for c in range(3):
                e = (ONE - fv) * ((ONE - fu) * environment[cell, c] + fu * environment[cell + 1, c])
                e += fv * ((ONE - fu) * environment[cell + SIDE, c] + fu * environment[cell + SIDE + 1, c])
                light = colours[i, c] * abs(colours[i, c]) * left + s * (e + environment[SHEEN, c] * f)
                value = light / np.float32(np.sqrt(max(abs(light), DARK)))
                shown[i, c] = value if value <= ONE else ONE + OVER * (value - ONE)


@parallel_kernel
def shade_rows_backward(means, gloss, turns, colours, environment, centre, g_shown, g_gloss, sums):
    """Implements ``shade_backward`` with parallel tasks.

    Each task adds its gradient of the environment to ``sums`` [tasks, ROWS, 3], which is initially
    zero.
    """
    count, glossy = means.shape[0], gloss.shape[0]
    k = environment[NEARNESS, 0]
    for task in prange((count + CHUNK - 1) // CHUNK):
        for i in range(task * CHUNK, min(count, (task + 1) * CHUNK)):
            if i >= glossy:
                continue
            for c in range(3):
                g_gloss[i, c] = ZERO
            w, x, y, z = turns[i, 0], turns[i, 1], turns[i, 2], turns[i, 3]
            a, b, d = gloss[i, 0], gloss[i, 1], gloss[i, 2]
            s = np.float32(np.sqrt(a * a + b * b + d * d))
            if not s > DULL:
                continue
            tx, ty, tz = TWO * (y * d - z * b), TWO * (z * a - x * d), TWO * (x * b - y * a)
            nx = (a + w * tx + y * tz - z * ty) / s
            ny = (b + w * ty + z * tx - x * tz) / s
            nz = (d + w * tz + x * ty - y * tx) / s
            vx, vy, vz = centre[0] - means[i, 0], centre[1] - means[i, 1], centre[2] - means[i, 2]
            far = np.float32(np.sqrt(vx * vx + vy * vy + vz * vz))
            vx, vy, vz = vx / far, vy / far, vz / far
            mu = nx * vx + ny * vy + nz * vz
            if not mu > ZERO:
                continue
            mx = means[i, 0] - environment[MIDDLE, 0]
            my = means[i, 1] - environment[MIDDLE, 1]
            mz = means[i, 2] - environment[MIDDLE, 2]
            px, py, pz = TWO * mu * nx - vx + k * mx, TWO * mu * ny - vy + k * my, TWO * mu * nz - vz + k * mz
            length = abs(px) + abs(py) + abs(pz)
            if not length > ZERO:
                continue
            ox, oy = px / length, py / length
            signx, signy = ONE if ox >= ZERO else -ONE, ONE if oy >= ZERO else -ONE
            gu = ox if pz >= ZERO else (ONE - abs(oy)) * signx
            gv = oy if pz >= ZERO else (ONE - abs(ox)) * signy
            fu, fv = (gu + ONE) * _STEP, (gv + ONE) * _STEP
            iu, iv = min(max(int(fu), 0), _LAST), min(max(int(fv), 0), _LAST)
            fu, fv = fu - np.float32(iu), fv - np.float32(iv)
            cell = iv * SIDE + iu
            away = ONE - mu
            f = away * away * away * away
            held = min(s, ONE)
            left = ONE - FALL * f * held
            g_s = g_f = along_u = along_v = ZERO
            for c in range(3):
                e00, e01 = environment[cell, c], environment[cell + 1, c]
                e10, e11 = environment[cell + SIDE, c], environment[cell + SIDE + 1, c]
                e = (ONE - fv) * ((ONE - fu) * e00 + fu * e01) + fv * ((ONE - fu) * e10 + fu * e11)
                size = abs(colours[i, c])
                inside = colours[i, c] * size
                mirrored = e + environment[SHEEN, c] * f
                light = inside * left + s * mirrored
                root = np.float32(np.sqrt(max(abs(light), DARK)))
                slope = ONE / (TWO * root) if abs(light) > DARK else ONE / root
                g = g_shown[i, c] * slope
                if light / root > ONE:
                    g *= OVER
                g_shown[i, c] = g * TWO * size * left
                g_e = g * s
                sums[task, cell, c] += g_e * (ONE - fv) * (ONE - fu)
                sums[task, cell + 1, c] += g_e * (ONE - fv) * fu
                sums[task, cell + SIDE, c] += g_e * fv * (ONE - fu)
                sums[task, cell + SIDE + 1, c] += g_e * fv * fu
                sums[task, SHEEN, c] += g_e * f
                g_s += g * mirrored
                if s < ONE:
                    g_s -= g * inside * FALL * f
                g_f += g_e * environment[SHEEN, c] - g * inside * FALL * held
                along_u += g_e * ((ONE - fv) * (e01 - e00) + fv * (e11 - e10))
                along_v += g_e * ((ONE - fu) * (e10 - e00) + fu * (e11 - e01))
            along_u, along_v = along_u * _STEP, along_v * _STEP
            g_ox = along_u if pz >= ZERO else -along_v * signx * signy
            g_oy = along_v if pz >= ZERO else -along_u * signx * signy
            both = g_ox * ox + g_oy * oy
            g_px = (g_ox - both * signx) / length
            g_py = (g_oy - both * signy) / length
            g_pz = -both * (ONE if pz >= ZERO else -ONE) / length
            sums[task, NEARNESS, 0] += g_px * mx + g_py * my + g_pz * mz
            g_mu = TWO * (g_px * nx + g_py * ny + g_pz * nz) - _FOUR * g_f * away * away * away
            hx, hy, hz = TWO * mu * g_px + g_mu * vx, TWO * mu * g_py + g_mu * vy, TWO * mu * g_pz + g_mu * vz
            radial = hx * nx + hy * ny + hz * nz
            hx = (hx - nx * radial) / s + nx * g_s
            hy = (hy - ny * radial) / s + ny * g_s
            hz = (hz - nz * radial) / s + nz * g_s
            tx, ty, tz = TWO * (hy * z - hz * y), TWO * (hz * x - hx * z), TWO * (hx * y - hy * x)  # rotate back
            g_gloss[i, 0] = hx + w * tx + tz * -y + ty * z
            g_gloss[i, 1] = hy + w * ty + tx * -z + tz * x
            g_gloss[i, 2] = hz + w * tz + ty * -x + tx * y
