"""The neighbour graph against brute force, and its small and degenerate cases."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.structure.neighbours import Neighbours


@pytest.mark.parametrize("count", [50, 200])
def test_the_nearest_are_those_of_brute_force(count: int) -> None:
    means = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    graph = Neighbours(means, 7, 3.0)
    distances = np.linalg.norm(means[:, None].astype(np.float64) - means, axis=-1)
    np.fill_diagonal(distances, np.inf)
    np.testing.assert_array_equal(graph.index, np.argsort(distances, axis=1)[:, :7])
    near = np.sort(distances, axis=1)[:, :7]
    np.testing.assert_allclose(graph.distances, near, rtol=1e-6)
    np.testing.assert_allclose(graph.weights, np.exp(-3.0 * near**2), rtol=1e-5)
    assert (graph.index.dtype, graph.weights.dtype, graph.distances.dtype) == (np.int32, np.float32, np.float32)


def test_coincident_gaussians_are_neighbours_but_none_is_its_own() -> None:
    means = np.zeros((30, 3), np.float32)
    means[20:] = np.random.default_rng(0).normal(size=(10, 3))
    graph = Neighbours(means, 5, 2000.0)
    assert (graph.index != np.arange(30)[:, None]).all()
    assert all(len(set(row)) == 5 for row in graph.index)
    assert (graph.index[:20] < 20).all()
    np.testing.assert_array_equal(graph.distances[:20], 0)
    np.testing.assert_array_equal(graph.weights[:20], 1)


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_fewer_gaussians_than_neighbours_leave_weights_zero(count: int) -> None:
    means = np.arange(3 * count, dtype=np.float32).reshape(count, 3) * 0.01
    graph = Neighbours(means, 20, 1.0)
    assert graph.index.shape == graph.weights.shape == graph.distances.shape == (count, 20)
    found = max(count - 1, 0)
    assert (graph.weights[:, :found] > 0).all()
    np.testing.assert_array_equal(graph.weights[:, found:], 0)
    assert ((graph.index >= 0) & (graph.index < max(count, 1))).all()
    if count == 2:
        np.testing.assert_array_equal(graph.index[:, 0], [1, 0])
