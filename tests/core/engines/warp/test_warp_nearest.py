"""Nearest neighbours on the device beside SciPy's, for points of all kinds of density."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

from scipy.spatial import cKDTree
from warp_cases import DEVICE, wp

from scas4d_core.engines.warp.nearest import nearest
from scas4d_core.engines.warp.neighbour_terms import weigh_pairs
from scas4d_core.structure.neighbours import Neighbours

RNG = np.random.default_rng(0)
RANDOM = RNG.normal(size=(700, 3))
MIDDLES = RNG.normal(size=(20, 3))
POINTS = {
    "random": RANDOM,
    "clustered": np.repeat(MIDDLES, 40, axis=0) + 1e-4 * RNG.normal(size=(800, 3)),
    "duplicated": np.repeat(MIDDLES, 40, axis=0),
    "on a line": np.outer(RNG.uniform(size=500), [1, -2, 3]),
    "on a grid": np.stack(np.meshgrid(*[np.arange(8)] * 3), axis=-1).reshape(-1, 3),
    "all equal": np.ones((300, 3)),
    "with one far away": np.concatenate([RANDOM, [[1e7, 0, 0]]]),
    "far from the origin": 1e4 + 0.1 * RANDOM,
    "fewer than wanted": RANDOM[:5],
    "one": RANDOM[:1],
    "none": RANDOM[:0],
}


@pytest.mark.parametrize("own", [False, True], ids=["others", "own first"])
@pytest.mark.parametrize("kind", POINTS)
def test_the_neighbours_are_those_of_the_host(kind: str, own: bool) -> None:
    points, count = POINTS[kind].astype(np.float32), 20
    index, squares = (array.numpy() for array in nearest(wp.array(points, dtype=wp.vec3, device=DEVICE), count, own))
    assert index.shape == squares.shape == (len(points), count)
    used = min(count, len(points) - 1 + own)
    if len(points) > 1:
        assert np.isfinite(squares[:, :used]).all()
        assert (np.diff(squares[:, :used], axis=1) >= 0).all()
        assert all(len({*row}) == used for row in index[:, :used])
        its_own = index[:, :used] == np.arange(len(points))[:, None]
        assert (its_own.sum(axis=1) == its_own[:, 0]).all()
        assert (its_own[:, 0] == own).all()
        exact = points.astype(np.float64)
        apart = np.linalg.norm(exact[index[:, :used]] - exact[:, None], axis=-1)
        np.testing.assert_allclose(np.sqrt(squares[:, :used]), apart, rtol=1e-12)
        # Equal distances mean equal sets, except for ties.
        true = cKDTree(exact).query(exact, used + 1 - own)[0][:, 1 - own :]
        np.testing.assert_allclose(np.sqrt(squares[:, :used]), true, rtol=1e-12)
        assert (index[:, used:] == 0).all()
        assert np.isinf(squares[:, used:]).all()


@pytest.mark.parametrize("kind", ["random", "duplicated", "fewer than wanted"])
def test_distances_and_weights_are_those_of_the_host(kind: str) -> None:
    points = POINTS[kind].astype(np.float32)
    graph = Neighbours(points, 20, 3.0)
    _, squares = nearest(wp.array(points, dtype=wp.vec3, device=DEVICE), graph.count)
    pairs = [wp.zeros(squares.shape, dtype=wp.float32, device=DEVICE) for _ in range(2)]
    wp.launch(weigh_pairs, squares.shape, [squares, graph.falloff, *pairs], device=DEVICE)
    for mine, true in zip(pairs, (graph.distances, graph.weights), strict=True):
        np.testing.assert_allclose(mine.numpy(), true, rtol=1e-6)
