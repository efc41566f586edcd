"""Rotations of neighbourhoods and shortest axes against SciPy and LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scas4d_core.kernels.turns import shortest_axes, turn_neighbourhoods

RNG = np.random.default_rng(0)
NEAR = RNG.integers(0, 200, (50, 32))


def turned(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    turns = np.full((len(NEAR), 3, 3), np.nan)
    turn_neighbourhoods(before.astype(np.float32), after.astype(np.float32), NEAR, turns)
    return turns


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 0), (1, 0.01, 0)])  # a ball, a plane and a thin strip
@pytest.mark.parametrize("angle", [0.0, 0.01, 1.5, 3.1])
def test_a_rigid_rotation_is_found(shape: tuple[float, float, float], angle: float) -> None:
    way = Rotation.from_rotvec(angle * np.array([1, 2, 2]) / 3)
    points = RNG.normal(size=(200, 3)) * shape
    turns = turned(points, way.apply(points) + np.array([1, 2, 3]))
    np.testing.assert_allclose(turns, np.broadcast_to(way.as_matrix(), turns.shape), atol=1e-3)


def test_it_is_the_best_proper_rotation() -> None:
    before = RNG.normal(size=(200, 3)).astype(np.float32)
    after = (before * [1, 1, -0.2] + RNG.normal(0, 0.3, (200, 3))).astype(np.float32)  # a reflection fits better
    turns = turned(before, after)
    for rows, turn in zip(NEAR, turns, strict=True):
        old, new = (
            array[rows].astype(np.float64) - array[rows].mean(axis=0, dtype=np.float64) for array in (before, after)
        )
        left, _, right = np.linalg.svd(new.T @ old)
        left[:, 2] *= np.sign(np.linalg.det(left @ right))
        np.testing.assert_allclose(turn, left @ right, atol=1e-9)


@pytest.mark.parametrize("shape", [(0, 0, 0), (1, 0, 0), (np.nan, 1, 1), (np.inf, 1, 1)])
def test_points_lines_and_values_that_are_not_finite_are_not_rotated(shape: tuple[float, float, float]) -> None:
    points = np.linspace(1, 2, 200)[:, None] * np.array(shape)
    np.testing.assert_array_equal(turned(points, points), np.broadcast_to(np.eye(3), (50, 3, 3)))


def test_the_shortest_axis_is_that_of_the_covariance() -> None:
    factors = RNG.normal(size=(100, 3, 3)).astype(np.float32)
    axes = np.empty((100, 3))
    shortest_axes(factors, axes)
    wide = factors.astype(np.float64)
    expected = np.linalg.eigh(wide @ wide.transpose(0, 2, 1)).eigenvectors[:, :, 0]
    np.testing.assert_allclose(np.abs((axes * expected).sum(axis=1)), 1, atol=1e-9)
