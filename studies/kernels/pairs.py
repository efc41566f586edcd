"""Blended pixel–Gaussian pairs: their number in an image, and the cost of their arithmetic alone.

A pair is blended if the Gaussian's alpha is at least the floor and the pixel is not finished. For each pair, the
micro-kernel computes what ``kernels.blend`` does forward and backward (exp, alpha, transmittance, four channels; the
products and sums of the gradients), in the same blocks of 16 pixels. Its Gaussians cover a whole tile and stay in
cache. There is no projection, sorting, list traversal or reduction, and no block is partly covered.
"""

from __future__ import annotations

from math import log2
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.kernels import lanes
from scas4d_core.kernels.blend import BLOCK, HALF_LOG2_E
from scas4d_core.kernels.jit import HALF, ONE, TWO, ZERO, exp, kernel, parallel_kernel
from scas4d_core.kernels.projection import (
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    REACH,
    SPLAT_COLUMNS,
)

Array = NDArray[np.float32]

GAUSSIANS = 32
"""Number of Gaussians in the micro-kernel's tile. They fit into the L1 cache together with their sums and the tile."""
CHANNELS = 4
SIDE = 16
"""Width and height of the micro-kernel's tile in pixels."""
PAIRS = GAUSSIANS * SIDE * SIDE
"""Number of pairs in one round over the micro-kernel's tile. Every SIMD lane computes a pair."""
SUMS = 6 + CHANNELS


def blended_pairs(
    splats: Array, counts: NDArray[np.int32], width: int, height: int, limits: Limits = DEFAULT
) -> tuple[NDArray[np.int32], int, Array]:
    """Counts the blended pairs of an image without tiles, Gaussian by Gaussian in depth order.

    Args:
        splats: [N, 16] splats of ``CpuRasterizer`` after ``forward``.
        counts: [N] counts of ``CpuRasterizer`` after ``forward``.
        width: image width in pixels.
        height: image height in pixels.
        limits: rasterizer limits.

    Returns:
        The number of pairs of each pixel, shape [H, W]; the number of pixels in the 4×4 blocks that a support touches;
        and the remaining light, shape [H, W]. A block-wise kernel computes at least these pixels. If the count is
        correct, the remaining light equals the rasterizer's ``transmittance``.
    """
    visible = np.flatnonzero(counts > 0)
    order = visible[np.argsort(splats[visible, DEPTH], kind="stable")]
    light = np.ones((height, width), np.float32)
    blocks = np.full((-(-height // BLOCK), -(-width // BLOCK)), -1, np.int64)
    pairs = np.zeros((height, width), np.int32)
    met = _count(splats, order, np.array(limits, np.float32), np.ones_like(light), light, pairs, blocks)
    return pairs, int(met) * BLOCK * BLOCK, light


@kernel  # type: ignore[untyped-decorator]
def _count(splats: Any, order: Any, limits: Any, alive: Any, light: Any, pairs: Any, last_met: Any) -> Any:
    floor, cap, stop = limits[0], limits[1], limits[2]
    height, width = light.shape
    met = 0
    for i in order:
        mx, my = splats[i, MEAN_X], splats[i, MEAN_Y]
        a, b, c, opacity = splats[i, CONIC_A], splats[i, CONIC_B], splats[i, CONIC_C], splats[i, OPACITY]
        determinant = max(a * c - b * b, np.float32(1e-30))
        # One pixel wider than the bounding box of the support: pixels outside fail the alpha test.
        half_x = np.sqrt(splats[i, REACH] * c / determinant) + ONE
        half_y = np.sqrt(splats[i, REACH] * a / determinant) + ONE
        for y in range(max(int(my - half_y), 0), min(int(my + half_y) + 1, height)):
            dy = np.float32(y) + HALF - my
            for x in range(max(int(mx - half_x), 0), min(int(mx + half_x) + 1, width)):
                dx = np.float32(x) + HALF - mx
                alpha = min(opacity * exp(-(HALF * a * dx * dx + b * dx * dy + HALF * c * dy * dy)), cap)
                if alpha >= floor:
                    if last_met[y // BLOCK, x // BLOCK] != i:
                        last_met[y // BLOCK, x // BLOCK] = i
                        met += 1
                    if alive[y, x] > ZERO:
                        after = alive[y, x] * (ONE - alpha)
                        if after >= stop:
                            pairs[y, x] += 1
                            alive[y, x] = after
                            light[y, x] = after
                        else:
                            alive[y, x] = ZERO
    return met


class MicroKernel:
    """Micro-kernel that does only the arithmetic of blended pairs.

    Args:
        tasks: number of tiles that are processed in parallel, usually one per thread.
        seed: random seed of the Gaussians.
    """

    def __init__(self, tasks: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.tasks = tasks
        self.splats = np.zeros((GAUSSIANS, SPLAT_COLUMNS), np.float32)
        self.splats[:, [MEAN_X, MEAN_Y]] = rng.uniform(4, 12, (GAUSSIANS, 2))
        # Wide and faint: alpha stays above the floor in the whole tile, and light remains behind the last Gaussian.
        self.splats[:, [CONIC_A, CONIC_C]] = rng.uniform(0.002, 0.004, (GAUSSIANS, 2))
        self.splats[:, CONIC_B] = rng.uniform(-0.001, 0.001, GAUSSIANS)
        self.splats[:, OPACITY] = rng.uniform(0.05, 0.15, GAUSSIANS)
        self.splats[:, LOG_OPACITY] = np.log2(self.splats[:, OPACITY])
        self.features = rng.uniform(0, 1, (GAUSSIANS, CHANNELS)).astype(np.float32)
        self.limits = np.array(DEFAULT, np.float32)
        self.image = np.zeros((tasks, SIDE * SIDE // lanes.COUNT, 1 + CHANNELS, lanes.COUNT), np.float32)
        self.sums = np.zeros((tasks, GAUSSIANS, SUMS, lanes.COUNT), np.float32)

    def run(self, rounds: int) -> int:
        """Runs the forward and backward pass ``rounds`` times per task and returns the total number of pairs."""
        _micro(self.splats, self.features, self.limits, rounds, self.image, self.sums)
        return rounds * self.tasks * PAIRS


@kernel  # type: ignore[untyped-decorator]
def _micro_forward(splats: Any, features: Any, limits: Any, image: Any) -> None:
    cap, stop = limits[1], limits[2]
    faintest = np.float32(log2(limits[0]))
    blocks, step = SIDE * SIDE // lanes.COUNT, lanes.COUNT * (1 + CHANNELS)
    state = np.empty(blocks * step + lanes.COUNT, np.float32)  # per block: remaining light, colours
    base = lanes.aligned(state)
    state[:] = ZERO
    for block in range(blocks):
        lanes.store(state, base + block * step, lanes.fill(ONE))
    for i in range(GAUSSIANS):
        splat = splats[i]
        a, b, c = splat[CONIC_A] * HALF_LOG2_E, splat[CONIC_B] * (TWO * HALF_LOG2_E), splat[CONIC_C] * HALF_LOG2_E
        log_opacity = splat[LOG_OPACITY]
        left_x = lanes.block_columns() + (HALF - splat[MEAN_X])
        top_y = lanes.block_rows() + (HALF - splat[MEAN_Y])
        for block in range(blocks):
            dx = left_x + np.float32(BLOCK * (block >> 2))
            dy = top_y + np.float32(BLOCK * (block & 3))
            power = log_opacity - (a * dx * dx + (b * dx + c * dy) * dy)
            place = base + block * step
            before = lanes.load(state, place)
            weight = lanes.minimum(lanes.exp2(power), lanes.fill(cap)) * before
            after = before - weight
            drawn = (power >= faintest) & (after >= stop)
            stopped = (power >= faintest) & (after < stop)
            weight = lanes.choose(drawn, weight, lanes.fill(ZERO))
            lanes.store(
                state, place, lanes.choose(stopped, ZERO - lanes.magnitude(before), lanes.choose(drawn, after, before))
            )
            for channel in range(CHANNELS):
                at = place + lanes.COUNT * (1 + channel)
                lanes.store(state, at, lanes.load(state, at) + weight * features[i, channel])
    for block in range(blocks):
        for plane in range(1 + CHANNELS):
            at = lanes.COUNT * plane
            lanes.store(image[block], at, lanes.load(state, base + block * step + at))


@kernel  # type: ignore[untyped-decorator]
def _micro_backward(splats: Any, features: Any, limits: Any, image: Any, out: Any) -> None:
    cap, stop = limits[1], limits[2]
    faintest = np.float32(log2(limits[0]))
    blocks, step = SIDE * SIDE // lanes.COUNT, lanes.COUNT * (2 + CHANNELS)
    state = np.empty(blocks * step + lanes.COUNT, np.float32)  # per block: remaining light, light behind, gradients
    base = lanes.aligned(state)
    for block in range(blocks):
        lanes.store(state, base + block * step, lanes.fill(ONE))
        for plane in range(1 + CHANNELS):
            at = lanes.COUNT * plane
            lanes.store(state, base + block * step + lanes.COUNT + at, lanes.load(image[block], at))
    for i in range(GAUSSIANS):
        splat = splats[i]
        a, b, c = splat[CONIC_A] * HALF_LOG2_E, splat[CONIC_B] * (TWO * HALF_LOG2_E), splat[CONIC_C] * HALF_LOG2_E
        log_opacity = splat[LOG_OPACITY]
        left_x = lanes.block_columns() + (HALF - splat[MEAN_X])
        top_y = lanes.block_rows() + (HALF - splat[MEAN_Y])
        s = lanes.fill(ZERO)
        sx = sy = sxx = sxy = syy = s
        t0 = t1 = t2 = t3 = s
        for block in range(blocks):
            dx = left_x + np.float32(BLOCK * (block >> 2))
            dy = top_y + np.float32(BLOCK * (block & 3))
            power = log_opacity - (a * dx * dx + (b * dx + c * dy) * dy)
            place = base + block * step
            before = lanes.load(state, place)
            behind = lanes.load(state, place + lanes.COUNT)
            g0 = lanes.load(state, place + 2 * lanes.COUNT)
            g1 = lanes.load(state, place + 3 * lanes.COUNT)
            g2 = lanes.load(state, place + 4 * lanes.COUNT)
            g3 = lanes.load(state, place + 5 * lanes.COUNT)
            dot = g0 * features[i, 0] + g1 * features[i, 1] + g2 * features[i, 2] + g3 * features[i, 3]
            alpha = lanes.minimum(lanes.exp2(power), lanes.fill(cap))
            weight = alpha * before
            after = before - weight
            drawn = (power >= faintest) & (after >= stop)
            stopped = (power >= faintest) & (after < stop)
            weight = lanes.choose(drawn, weight, lanes.fill(ZERO))
            behind = behind - weight * dot
            lanes.store(
                state, place, lanes.choose(stopped, ZERO - lanes.magnitude(before), lanes.choose(drawn, after, before))
            )
            lanes.store(state, place + lanes.COUNT, behind)
            g = weight * dot - behind * (alpha / (ONE - alpha))
            g = lanes.choose(drawn & (alpha < cap), g, lanes.fill(ZERO))
            gx, gy = g * dx, g * dy
            s += g
            sx += gx
            sy += gy
            sxx += gx * dx
            sxy += gx * dy
            syy += gy * dy
            t0 += weight * g0
            t1 += weight * g1
            t2 += weight * g2
            t3 += weight * g3
        column = 0
        for total in (s, sx, sy, sxx, sxy, syy, t0, t1, t2, t3):
            lanes.store(out[i], column, total)
            column += lanes.COUNT


@parallel_kernel  # type: ignore[untyped-decorator]
def _micro(splats: Any, features: Any, limits: Any, rounds: Any, image: Any, sums: Any) -> None:
    for task in prange(image.shape[0]):
        for _ in range(rounds):
            _micro_forward(splats, features, limits, image[task])
            _micro_backward(splats, features, limits, image[task], sums[task])
