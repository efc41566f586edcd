"""The hierarchy: nested, contiguous, every moving Gaussian once, the same for the same scene."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scas4d_core.structure.hierarchy import Hierarchy, build_hierarchy


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)


def assert_whole(hierarchy: Hierarchy, moving: np.ndarray) -> None:
    """The laws that kernels rely on."""
    np.testing.assert_array_equal(np.sort(hierarchy.rows), np.flatnonzero(moving))
    for labels, starts in zip(hierarchy.labels, hierarchy.starts, strict=True):
        assert labels.dtype == np.int32
        assert starts[0] == 0
        assert starts[-1] == len(hierarchy.rows)
        assert (np.diff(starts) > 0).all()
        np.testing.assert_array_equal(labels, np.repeat(np.arange(len(starts) - 1), np.diff(starts)))
    for coarse, fine in pairwise(hierarchy.starts):
        assert set(coarse) <= set(fine)  # a coarse cluster ends where a fine one ends: nested


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 120), st.integers(1, 12), st.floats(0, 1), st.sampled_from([(4, 16, 40), (1, 2, 3), (7,), ()]))
def test_clusters_are_nested_contiguous_and_complete(
    count: int, smallest: int, share: float, wished: tuple[int, ...]
) -> None:
    moving = np.random.default_rng(count).uniform(size=count) < share
    hierarchy = build_hierarchy(cloud(count), moving, wished, smallest)
    assert_whole(hierarchy, moving)
    cap = max(1, int(moving.sum()) // smallest)
    assert all(size <= min(wish, cap) for size, wish in zip(hierarchy.sizes, wished, strict=False))


def test_as_many_clusters_as_wished_where_there_is_room() -> None:
    hierarchy = build_hierarchy(cloud(4000), np.ones(4000, bool), (8, 40, 160), 8)
    assert hierarchy.sizes == (8, 40, 160)
    assert_whole(hierarchy, np.ones(4000, bool))


def test_layers_that_the_cap_makes_equal_are_one() -> None:
    moving = np.ones(200, bool)
    assert build_hierarchy(cloud(200), moving, (4, 64, 320, 1280), 8).sizes == (4, 25)
    assert build_hierarchy(cloud(200), moving, (64, 320, 1280), 8).sizes == (25,)
    assert build_hierarchy(cloud(5), moving[:5], (64, 320, 1280), 8).sizes == (1,)


def test_coincident_gaussians_share_a_cluster() -> None:
    moving = np.ones(100, bool)
    hierarchy = build_hierarchy(np.ones((100, 3), np.float32), moving, (2, 4, 8), 4)
    assert_whole(hierarchy, moving)
    assert set(hierarchy.sizes) == {1}
    half = cloud(100)
    half[:60] = half[0]
    hierarchy = build_hierarchy(half, moving, (2, 4, 8), 4)
    assert_whole(hierarchy, moving)
    clusters = {int(label) for label, row in zip(hierarchy.labels[-1], hierarchy.rows, strict=True) if row < 60}
    assert len(clusters) == 1


def test_nothing_moving_has_no_layer() -> None:
    hierarchy = build_hierarchy(cloud(10), np.zeros(10, bool), (2, 4), 1)
    assert len(hierarchy.rows) == 0
    assert hierarchy.sizes == ()


def test_standing_gaussians_do_not_matter() -> None:
    means = cloud(300)
    moving = np.arange(300) % 3 != 0
    other = means.copy()
    other[~moving] += 100
    one, two = (build_hierarchy(array, moving, (3, 9, 20), 8) for array in (means, other))
    np.testing.assert_array_equal(one.rows, two.rows)
    np.testing.assert_array_equal(one.labels[-1], two.labels[-1])


def test_the_same_input_gives_the_same_clusters_and_another_seed_others() -> None:
    means, moving = cloud(1000), np.ones(1000, bool)
    one, two, other = (build_hierarchy(means, moving, (4, 20, 80), 8, seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.rows, two.rows)
    for a, b in zip(one.labels, two.labels, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(one.rows, other.rows)


def test_clusters_are_near_in_space() -> None:
    """Two distant clumps never share a cluster, in any layer."""
    means = cloud(400) * 0.1
    means[::2] += 10
    hierarchy = build_hierarchy(means, np.ones(400, bool), (2, 8, 32), 8)
    for starts in hierarchy.starts:
        for begin, end in pairwise(starts):
            assert len(set(hierarchy.rows[begin:end] % 2)) == 1


def test_parents_are_evened_out() -> None:
    """The spread within the coarse clusters is near that of clusters that need not be nested."""
    points = cloud(4000)
    moving = np.ones(len(points), np.bool_)

    def spread(clusters: tuple[int, ...]) -> float:
        hierarchy = build_hierarchy(points, moving, clusters, 8)
        labels, sorted_points = hierarchy.labels[0], points[hierarchy.rows]
        counts = np.bincount(labels)
        means = np.stack([np.bincount(labels, sorted_points[:, k]) for k in range(3)], axis=1) / counts[:, None]
        return float(np.square(sorted_points - means[labels]).sum())

    assert spread((16, 320)) < 1.15 * spread((16,))


def test_a_sample_is_clustered_where_there_are_many(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scas4d_core.structure.hierarchy.KMEANS_SAMPLE_PER_CLUSTER", 10)
    hierarchy = build_hierarchy(cloud(2000), np.ones(2000, bool), (2, 5, 20), 8)
    assert_whole(hierarchy, np.ones(2000, bool))
    assert hierarchy.sizes == (2, 5, 20)


@pytest.mark.parametrize("wished", [(4, 4), (8, 2)])
def test_numbers_that_do_not_ascend_are_refused(wished: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="must ascend"):
        build_hierarchy(cloud(100), np.ones(100, bool), wished, 1)
