"""Patch matches, against an implementation with SciPy, and on images and motions that are known."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from scas4d_core.kernels import patch_matches as module
from scas4d_core.kernels.patch_matches import LEVELS, fit_clusters, match_patches

Float = NDArray[np.float64]

WIDTH, HEIGHT = 96, 64
POSE = np.eye(4)[:3]
LENS = np.array([80.0, 90.0, 48.0, 32.0])
SHIFT = np.array([4.3, -2.6])
"""Pixels by which the image is shifted relative to the rendering."""


def texture(seed: int = 0) -> Float:
    """A random texture with structures of a few pixels."""
    return gaussian_filter(np.random.default_rng(seed).normal(0, 1, (2 * HEIGHT, 2 * WIDTH)), 2.5)


def seen(shift: Float) -> NDArray[np.float32]:
    """The texture, shifted by pixels (x, y)."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    plane = map_coordinates(texture(), [rows - shift[1] + 30, columns - shift[0] + 40], order=3)
    return plane.astype(np.float32)


def pyramid(plane: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    levels = [plane]
    while len(levels) < LEVELS:
        last = levels[-1]
        levels.append((last[0::2, 0::2] + last[1::2, 0::2] + last[0::2, 1::2] + last[1::2, 1::2]) / np.float32(4))
    return levels


def matched(
    source: NDArray[np.float32], target: NDArray[np.float32], points: Float, depth: NDArray[np.float32] | None = None
) -> tuple[Float, Float, Float]:
    """The normal equations and weights of points in the one camera."""
    levels = pyramid(source)
    sizes = np.array([level.shape[::-1] for level in levels], np.int64)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]]).astype(np.int64)
    flat = [np.concatenate([level.ravel() for level in pyramid(plane)]) for plane in (source, target)]
    normal, right, weight = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3)), np.zeros(len(points))
    depth = np.full(WIDTH * HEIGHT, 2.0, np.float32) if depth is None else depth.ravel()
    match_patches(*flat, depth, starts, sizes, POSE, LENS, 0.05, points, normal, right, weight)
    return normal, right, weight


def at_pixels(pixels: Float, depth: float = 2.0) -> Float:
    """Points at a depth that are seen in pixels [N, 2]."""
    flat = (pixels - LENS[2:]) / LENS[:2] * depth
    return np.column_stack([flat, np.full(len(flat), depth)])


PIXELS = np.random.default_rng(1).uniform([16, 14], [WIDTH - 16, HEIGHT - 14], (40, 2))


def test_a_shifted_image_is_found_to_a_tenth_of_a_pixel() -> None:
    normal, right, weight = matched(seen(np.zeros(2)), seen(SHIFT), at_pixels(PIXELS))
    assert weight.min() > 0.3  # every point is visible and textured
    plane = normal[:, :2, :2]  # a camera does not see depth
    moved = np.linalg.solve(plane, right[:, :2, None])[..., 0] / 2.0 * LENS[:2]
    np.testing.assert_allclose(moved, np.tile(SHIFT, (len(PIXELS), 1)), atol=0.1)


def by_scipy(
    source: NDArray[np.float32], target: NDArray[np.float32], depth: NDArray[np.float32], u: float, v: float
) -> tuple[Float, Float]:
    """The flow [2] and the information matrix [2, 2] of one point at a depth of 2."""
    flow = np.zeros(2)
    half = module.HALF_PATCH
    offsets = np.arange(module.SIDE) - half + 0.5
    for level in reversed(range(LEVELS)):
        before, after = (pyramid(plane)[level].astype(np.float64) for plane in (source, target))

        def read(plane: Float, dx: float, dy: float, level: int = level) -> Float:
            x, y = np.meshgrid(u * 0.5**level - 0.5 + offsets + dx, v * 0.5**level - 0.5 + offsets + dy)
            return map_coordinates(plane, [y, x], order=1, mode="nearest")

        gradient = np.stack(
            [
                (read(before, 1, 0) - read(before, -1, 0)) / 2,
                (read(before, 0, 1) - read(before, 0, -1)) / 2,
            ]
        ).reshape(2, -1)
        x, y = ((at * 0.5**level + offsets) / 0.5**level for at in (u, v))  # in pixels of the finest level
        columns, rows = (at.astype(int).clip(0, side - 1) for at, side in ((x, WIDTH), (y, HEIGHT)))
        weights = np.where(np.abs(depth[np.ix_(rows, columns)] - 2.0) <= 0.05, 1.0, module.BEHIND)
        patch, total = read(before, 0, 0), weights.sum()
        structure = (gradient * weights.ravel()) @ gradient.T
        damped = structure + module.NOISE * total * np.eye(2)
        flow = 2 * flow
        start = flow
        for _ in range(module.STEPS):
            found = read(after, *flow)
            error = found - patch - (weights * (found - patch)).sum() / total
            step = -np.linalg.solve(damped, gradient @ (weights * error).ravel())
            flow = flow + step
            if step @ step < module.CONVERGED**2:
                break
        if (flow - start) @ (flow - start) > module.SIDE**2:
            flow = start
    confidence = 1 / (1 + (weights * error**2).sum() / total / module.MISFIT**2)
    return flow, confidence * np.linalg.inv(damped) @ structure


@pytest.mark.parametrize("edge", [False, True])
def test_flow_and_information_are_those_of_scipy(edge: bool) -> None:
    """With an edge, every third column of the image shows a surface in front of the points' or behind it."""
    source, target = seen(np.zeros(2)), seen(SHIFT)
    points = at_pixels(PIXELS)
    depth = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    if edge:
        depth[:, 10::3] = 2.3
    normal, right, weight = matched(source, target, points, depth)
    assert edge or weight.all()
    for index, (u, v) in enumerate(PIXELS):
        flow, information = by_scipy(source, target, depth, u, v)
        x, y, z = points[index]
        jacobian = np.array([[LENS[0] / z, 0, -LENS[0] * x / z**2], [0, LENS[1] / z, -LENS[1] * y / z**2]])
        np.testing.assert_allclose(normal[index], jacobian.T @ information @ jacobian, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(
            right[index], jacobian.T @ information @ flow, rtol=1e-4, atol=2e-3
        )  # clamped at the edges
        np.testing.assert_allclose(weight[index], np.trace(information) / 2, rtol=1e-6)


def test_points_that_are_hidden_or_outside_do_not_count() -> None:
    source = seen(np.zeros(2))
    hidden, outside, behind = at_pixels(PIXELS[:1], 2.2), at_pixels(np.array([[-5.0, 9.0]])), [[0.0, 0, -1]]
    normal, right, weight = matched(source, source, np.concatenate([hidden, outside, behind]))
    assert not normal.any()
    assert not right.any()
    assert not weight.any()


def test_a_surface_without_texture_counts_little_and_an_edge_in_one_direction() -> None:
    blank = np.full((HEIGHT, WIDTH), 0.5, np.float32)
    assert matched(blank, blank, at_pixels(PIXELS))[2].max() < 1e-6
    edge = blank.copy()
    edge[:, 48:] = 1
    normal, _, _ = matched(edge, edge, at_pixels(np.array([[48.0, 32.0]])))
    values = np.sort(np.linalg.eigvalsh(normal[0]))
    assert values[1] < 1e-6 * values[2]


@pytest.mark.parametrize("threads", [1, 2])
def test_results_do_not_depend_on_the_number_of_threads(threads: int) -> None:
    usual = matched(seen(np.zeros(2)), seen(SHIFT), at_pixels(PIXELS))
    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    try:
        for one, other in zip(usual, matched(seen(np.zeros(2)), seen(SHIFT), at_pixels(PIXELS)), strict=True):
            np.testing.assert_array_equal(one, other)
    finally:
        numba.set_num_threads(before)


def followed(
    points: Float, targets: Float, starts: list[int], information: Float, damping: float = 1e-6, smallest: float = 1.0
) -> tuple[Float, Float, Float]:
    """The motion of clusters whose points have matches at targets, in pixels of ``information`` per metre squared."""
    normal = np.broadcast_to(information, (len(points), 3, 3)).copy()
    right = np.einsum("nij,nj->ni", normal, targets - points)
    count = len(starts) - 1
    turns, before, after = (np.full((count, 3), np.nan) for _ in range(3))
    weight = np.full(len(points), 2.0)
    fit_clusters(points, normal, right, weight, np.array(starts), damping, smallest, turns, before, after)
    return turns, before, after


PIXELS_PER_METRE = 100.0
INFORMATION = 4 * PIXELS_PER_METRE**2 / 3 * np.eye(3)  # a match has the trace 2 · pixels² in two cameras


def test_clusters_follow_their_rigid_motions_despite_outliers() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(0, 0.1, (60, 3)) + np.repeat([[0, 0, 0], [1, 0, 0]], 30, axis=0)
    turn = Rotation.from_rotvec([0.1, 0.3, -0.2])
    targets = points.copy()
    targets[:30] = turn.apply(points[:30]) + np.array([0.2, 0, 0.1])
    targets[:30][::10] += 1.0  # outliers of 100 pixels
    turns, before, after = followed(points, targets, [0, 30, 60], INFORMATION)
    found = Rotation.from_quat(np.append(turns[0], 1))
    np.testing.assert_allclose(before, [points[:30].mean(axis=0), points[30:].mean(axis=0)])
    moved = found.apply(points[:30] - before[0]) + after[0]
    inliers = np.arange(30) % 10 != 0
    assert np.linalg.norm(moved - targets[:30], axis=1)[inliers].max() < 0.03
    assert not turns[1].any()
    np.testing.assert_array_equal(after[1], before[1])  # the second cluster rests


def by_numpy(points: Float, normal: Float, right: Float, weight: Float, damping: float) -> tuple[Float, Float]:
    """The positions of one cluster's points after its motion, and the matrix [3, 3] of its rotation."""
    places, turned, reliability = points.copy(), np.eye(3), np.ones(len(points))
    prior = damping * np.trace(normal, axis1=1, axis2=2).sum() / weight.sum() * len(points) / 3
    for _ in range(module.ROUNDS):
        arms = places - places.mean(axis=0)
        about = np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=2)
        basis = np.concatenate([about, np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
        moments = right - np.einsum("nij,nj->ni", normal, places - points)
        lever = np.square(arms).sum() / len(points) / 3
        system = np.einsum("n,nai,nab,nbj->ij", reliability, basis, normal, basis)
        system += prior * np.diag([lever] * 3 + [1] * 3)
        unknowns = np.linalg.solve(system, np.einsum("n,nai,na->i", reliability, basis, moments))
        turn = Rotation.from_quat(np.append(unknowns[:3] / 2, 1)).as_matrix()
        places, turned = places.mean(axis=0) + unknowns[3:] + arms @ turn.T, turn @ turned
        left = np.square(right - np.einsum("nij,nj->ni", normal, places - points)).sum(axis=1)
        squared = left / (np.trace(normal, axis1=1, axis2=2) * weight)
        reliability = 1 / (1 + squared / module.OUTLIER_PX**2)
    return places, turned


@pytest.mark.parametrize("threads", [1, 2])
def test_motions_are_those_of_numpy_whatever_the_number_of_threads(threads: int) -> None:
    rng = np.random.default_rng(2)
    points = rng.normal(0, 0.1, (50, 3))
    roots = rng.normal(0, 60, (50, 3, 3))
    normal, weight = roots @ np.swapaxes(roots, 1, 2), rng.uniform(0.5, 3, 50)
    shifts = Rotation.from_rotvec([0.2, -0.1, 0.3]).apply(points) - points + rng.normal(0.05, 0.03, (50, 3))
    right = np.einsum("nij,nj->ni", normal, shifts)
    turns, before, after = (np.empty((2, 3)) for _ in range(3))
    used = numba.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    try:
        fit_clusters(points, normal, right, weight, np.array([0, 20, 50]), 0.1, 0.0, turns, before, after)
    finally:
        numba.set_num_threads(used)
    for cluster, rows in enumerate((slice(0, 20), slice(20, 50))):
        places, turned = by_numpy(points[rows], normal[rows], right[rows], weight[rows], 0.1)
        np.testing.assert_allclose(before[cluster], points[rows].mean(axis=0), atol=1e-12)
        np.testing.assert_allclose(after[cluster], places.mean(axis=0), rtol=1e-7, atol=1e-9)
        found = Rotation.from_quat(np.append(turns[cluster], 1)).as_matrix()
        np.testing.assert_allclose(found, turned, rtol=1e-7, atol=1e-9)


def test_small_motions_and_clusters_without_matches_rest() -> None:
    points = np.random.default_rng(0).normal(0, 0.1, (40, 3))
    shift = np.array([0.5 / PIXELS_PER_METRE, 0, 0])
    turns, before, after = followed(points, points + shift, [0, 40], INFORMATION)
    np.testing.assert_array_equal(after, before)
    assert not turns.any()
    turns, before, after = followed(points, points + 4 * shift, [0, 40], INFORMATION)
    np.testing.assert_allclose(after - before, [4 * shift], atol=1e-4)
    for few, information in ((points, np.zeros((3, 3))), (points[:1], INFORMATION), (points[:0], INFORMATION)):
        turns, before, after = followed(few, few + 1, [0, len(few)], information)
        np.testing.assert_array_equal(after, before)  # also without information, and with one point
        assert not turns.any()


def test_damping_holds_a_cluster_back() -> None:
    points = np.random.default_rng(0).normal(0, 0.1, (40, 3))
    shifts = [
        followed(points, points + np.array([0.05, 0, 0]), [0, 40], INFORMATION, damping)[2][0, 0] - points[:, 0].mean()
        for damping in (1e-6, 0.5, 5.0)
    ]
    assert 0.05 > shifts[0] - 1e-6 > shifts[1] > shifts[2] > 0
