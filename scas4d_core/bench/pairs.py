"""Blended pixel–Gaussian pairs: how many a picture has, and what their arithmetic alone costs.

A pair is blended where the Gaussian's alpha is at least the floor and the pixel is not finished. The micro-kernel does
for each pair what ``kernels.blend`` does forward and backward (exp, alpha, transmittance, four channels; the products
and sums of the gradients), in the same rows of 16 pixels, on Gaussians that cover a whole tile and stay in cache: no
projection, no order, no lists, no rows half outside, no reduction of the sums.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from scas4d_core.kernels.blend import EXP_LOWEST, exp_in_support
from scas4d_core.kernels.jit import HALF, ONE, ZERO, kernel, parallel_kernel
from scas4d_core.kernels.projection import CONIC_A, CONIC_B, CONIC_C, DEPTH, MEAN_X, MEAN_Y, OPACITY, REACH, TILE
from scas4d_core.rasterize.limits import DEFAULT, Limits

Array = NDArray[np.float32]

GAUSSIANS = 32
"""Of the micro-kernel's tile: with their sums they fit into the first-level cache beside the tile."""
CHANNELS = 4
PAIRS = GAUSSIANS * TILE * TILE
"""Pairs of one round of the micro-kernel's tile: every lane is one."""
SUMS = 5 + CHANNELS


def blended_pairs(
    splats: Array, counts: NDArray[np.int32], width: int, height: int, limits: Limits = DEFAULT
) -> tuple[int, int, Array]:
    """Count the pairs of a picture, Gaussian by Gaussian in depth order, without tiles.

    Args:
        splats: [N, 8], counts: [N] of ``CpuRasterizer`` after ``forward``. width, height: pixels.

    Returns:
        Pairs; places in rows of 16 pixels that some support meets (what a row-wise kernel computes at least); and the
        light left [H, W], which is the rasterizer's ``rest`` if the count is right.
    """
    visible = np.flatnonzero(counts > 0)
    order = visible[np.argsort(splats[visible, DEPTH], kind="stable")]
    light = np.ones((height, width), np.float32)
    pairs, lanes = _count(splats, order, np.array(limits, np.float32), np.ones_like(light), light)
    return int(pairs), int(lanes), light


@kernel  # type: ignore[untyped-decorator]
def _count(splats: Any, order: Any, limits: Any, alive: Any, light: Any) -> Any:
    floor, cap, stop = limits[0], limits[1], limits[2]
    height, width = light.shape
    pairs = 0
    rows = 0
    for i in order:
        mx, my = splats[i, MEAN_X], splats[i, MEAN_Y]
        a, b, c, opacity = splats[i, CONIC_A], splats[i, CONIC_B], splats[i, CONIC_C], splats[i, OPACITY]
        determinant = max(a * c - b * b, np.float32(1e-30))
        # A pixel wider than the support's box: what is outside fails the test of alpha.
        half_x = np.sqrt(splats[i, REACH] * c / determinant) + ONE
        half_y = np.sqrt(splats[i, REACH] * a / determinant) + ONE
        for y in range(max(int(my - half_y), 0), min(int(my + half_y) + 1, height)):
            dy = np.float32(y) + HALF - my
            along, constant = b * dy, HALF * c * dy * dy
            segment = -1
            for x in range(max(int(mx - half_x), 0), min(int(mx + half_x) + 1, width)):
                dx = np.float32(x) + HALF - mx
                power = -(HALF * a * dx * dx + along * dx + constant)
                alpha = min(opacity * exp_in_support(power), cap)
                if alpha >= floor and power >= EXP_LOWEST:
                    if x // TILE != segment:
                        segment = x // TILE
                        rows += 1
                    if alive[y, x] > ZERO:
                        after = alive[y, x] * (ONE - alpha)
                        if after >= stop:
                            pairs += 1
                            alive[y, x] = after
                            light[y, x] = after
                        else:
                            alive[y, x] = ZERO
    return pairs, rows * TILE


class MicroKernel:
    """The arithmetic of pairs alone; ``run`` does ``rounds`` of ``PAIRS`` pairs on each of ``tasks`` threads."""

    def __init__(self, tasks: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.tasks = tasks
        self.splats = np.zeros((GAUSSIANS, 8), np.float32)
        self.splats[:, [MEAN_X, MEAN_Y]] = rng.uniform(4, 12, (GAUSSIANS, 2))
        # Wide and faint: alpha stays above the floor in the whole tile, and light is left behind the last.
        self.splats[:, [CONIC_A, CONIC_C]] = rng.uniform(0.002, 0.004, (GAUSSIANS, 2))
        self.splats[:, CONIC_B] = rng.uniform(-0.001, 0.001, GAUSSIANS)
        self.splats[:, OPACITY] = rng.uniform(0.05, 0.15, GAUSSIANS)
        self.features = rng.uniform(0, 1, (GAUSSIANS, CHANNELS)).astype(np.float32)
        self.limits = np.array(DEFAULT, np.float32)
        self.image = np.zeros((tasks, TILE, 2 + CHANNELS, TILE), np.float32)
        self.sums = np.zeros((tasks, GAUSSIANS, SUMS, TILE), np.float32)

    def run(self, rounds: int) -> int:
        """Forward and backward; returns the pairs."""
        _micro(self.splats, self.features, self.limits, rounds, self.image, self.sums)
        return rounds * self.tasks * PAIRS


@kernel  # type: ignore[untyped-decorator]
def _micro_forward(splats: Any, features: Any, limits: Any, image: Any) -> None:
    floor, cap, stop = limits[0], limits[1], limits[2]
    state = np.empty((TILE, 2 + CHANNELS, TILE), np.float32)  # per row: light still alive, light left, colours
    weight = np.empty(TILE, np.float32)
    state[:, :2] = ONE
    state[:, 2:] = ZERO
    for i in range(GAUSSIANS):
        mx, my = splats[i, MEAN_X], splats[i, MEAN_Y]
        a, b, c, opacity = splats[i, CONIC_A], splats[i, CONIC_B], splats[i, CONIC_C], splats[i, OPACITY]
        f0, f1, f2, f3 = features[i, 0], features[i, 1], features[i, 2], features[i, 3]
        for row in range(TILE):
            dy = np.float32(row) + HALF - my
            lanes = state[row]
            along = b * dy
            constant = HALF * c * dy * dy
            for k in range(TILE):
                dx = HALF + np.float32(k) - mx
                power = -(HALF * a * dx * dx + along * dx + constant)
                alpha = min(opacity * exp_in_support(power), cap)
                alpha = alpha if (alpha >= floor) & (power >= EXP_LOWEST) else ZERO
                before = lanes[0, k]
                after = before * (ONE - alpha)
                goes_on = after >= stop
                weight[k] = alpha * before if goes_on else ZERO
                lanes[1, k] = after if goes_on else lanes[1, k]
                lanes[0, k] = after if goes_on else ZERO
            for k in range(TILE):
                lanes[2, k] += weight[k] * f0
                lanes[3, k] += weight[k] * f1
                lanes[4, k] += weight[k] * f2
                lanes[5, k] += weight[k] * f3
    for row in range(TILE):
        for channel in range(2 + CHANNELS):
            for k in range(TILE):
                image[row, channel, k] = state[row, channel, k]


@kernel  # type: ignore[untyped-decorator]
def _micro_backward(splats: Any, features: Any, limits: Any, image: Any, out: Any) -> None:
    floor, cap, stop = limits[0], limits[1], limits[2]
    state = np.empty((TILE, 2 + CHANNELS, TILE), np.float32)  # per row: light alive, remaining, gradients
    sums = np.empty((SUMS, TILE), np.float32)  # over rows: 1, dy, dy^2; this row: dot, weight; features
    for row in range(TILE):
        for channel in range(2 + CHANNELS):
            for k in range(TILE):
                state[row, channel, k] = image[row, channel, k] if channel > 0 else ONE
    for i in range(GAUSSIANS):
        mx, my = splats[i, MEAN_X], splats[i, MEAN_Y]
        a, b, c, opacity = splats[i, CONIC_A], splats[i, CONIC_B], splats[i, CONIC_C], splats[i, OPACITY]
        f0, f1, f2, f3 = features[i, 0], features[i, 1], features[i, 2], features[i, 3]
        sums[:] = ZERO
        for row in range(TILE):
            dy = np.float32(row) + HALF - my
            lanes = state[row]
            along = b * dy
            constant = HALF * c * dy * dy
            for k in range(TILE):
                sums[3, k] = f0 * lanes[2, k] + f1 * lanes[3, k] + f2 * lanes[4, k] + f3 * lanes[5, k]
            for k in range(TILE):
                dx = HALF + np.float32(k) - mx
                power = -(HALF * a * dx * dx + along * dx + constant)
                free = opacity * exp_in_support(power)
                alpha = min(free, cap)
                alpha = alpha if (alpha >= floor) & (power >= EXP_LOWEST) else ZERO
                before = lanes[0, k]
                after = before * (ONE - alpha)
                goes_on = after >= stop
                weight = alpha * before if goes_on else ZERO
                dot = sums[3, k]
                behind = lanes[1, k] - weight * dot
                g = alpha * (before * dot - behind / (ONE - alpha))
                g = g if goes_on & (free < cap) else ZERO
                lanes[1, k] = behind
                lanes[0, k] = after if goes_on else ZERO
                sums[0, k] += g
                sums[1, k] += g * dy
                sums[2, k] += g * dy * dy
                sums[4, k] = weight
            for k in range(TILE):
                sums[5, k] += sums[4, k] * lanes[2, k]
                sums[6, k] += sums[4, k] * lanes[3, k]
                sums[7, k] += sums[4, k] * lanes[4, k]
                sums[8, k] += sums[4, k] * lanes[5, k]
        for column in range(SUMS):
            for k in range(TILE):
                out[i, column, k] = sums[column, k]


@parallel_kernel  # type: ignore[untyped-decorator]
def _micro(splats: Any, features: Any, limits: Any, rounds: Any, image: Any, sums: Any) -> None:
    for task in prange(image.shape[0]):
        for _ in range(rounds):
            _micro_forward(splats, features, limits, image[task])
            _micro_backward(splats, features, limits, image[task], sums[task])
