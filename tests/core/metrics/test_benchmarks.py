"""Benchmark metrics, compared with counts over single positions."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.metrics import benchmark_scores, scaled_thresholds, survival, tapvid_thresholds
from scas4d_core.metrics.benchmarks import mean_trajectory_error


def counted_one_by_one(errors, seen, visible, thresholds):
    """Returns the scores from true positives, false positives and false negatives, as the benchmark's paper states."""
    jaccards, withins = [], []
    frames, tracks = errors.shape
    for threshold in thresholds:
        true_positives = false_positives = false_negatives = near_and_visible = 0
        for t in range(1, frames):
            for q in range(tracks):
                near = bool(errors[t, q] < threshold)
                hit = near and visible[t, q]
                true_positives += hit and seen[t, q]
                false_positives += seen[t, q] and not hit
                false_negatives += visible[t, q] and not (hit and seen[t, q])
                near_and_visible += hit
        jaccards.append(true_positives / (true_positives + false_positives + false_negatives))
        withins.append(near_and_visible / visible[1:].sum())
    return np.mean(jaccards), np.mean(withins), (seen == visible)[1:].mean()


def test_scores_equal_counts_over_single_positions() -> None:
    rng = np.random.default_rng(0)
    errors = rng.exponential(2.0, (7, 30))
    errors[3, :5] = np.nan
    visible, seen = rng.random((2, 7, 30)) < 0.7
    thresholds = np.array([1.0, 2.0, 4.0])
    scores = benchmark_scores(errors, seen, visible, thresholds[:, None, None])
    assert scores == pytest.approx(counted_one_by_one(errors, seen, visible, thresholds))


def test_a_perfect_track_has_perfect_scores_and_a_hidden_one_none() -> None:
    visible = np.array([[True, True], [True, False], [True, True]])
    perfect = benchmark_scores(np.zeros((3, 2)), visible, visible, np.ones((1, 1, 1)))
    assert perfect == (1, 1, 1)
    hidden = benchmark_scores(np.zeros((2, 1)), np.zeros((2, 1), bool), np.zeros((2, 1), bool), np.ones((1, 1, 1)))
    assert np.isnan(hidden[:2]).all()
    assert hidden.occlusion_accuracy == 1


def test_thresholds() -> None:
    depth = np.full((2, 3), 4.0)
    thresholds = tapvid_thresholds(depth, (100.0, 400.0))
    assert thresholds.shape == (5, 2, 3)
    assert thresholds[:, 0, 0].tolist() == pytest.approx([0.02, 0.04, 0.08, 0.16, 0.32])
    assert scaled_thresholds(1.8).ravel().tolist() == pytest.approx([0.05, 0.1, 0.2, 0.4])


def test_a_track_that_comes_back_does_not_survive() -> None:
    errors = np.array([[0.0, 0.0], [0.1, 0.1], [0.6, 0.1], [0.1, np.nan], [0.1, 0.1]])
    assert survival(errors, extent=1.8) == pytest.approx((1 / 4 + 2 / 4) / 2)


def test_lost_tracks_have_an_infinite_error() -> None:
    errors, visible = np.array([[0.0], [1.0], [np.nan], [np.nan]]), np.ones((4, 1), bool)
    assert mean_trajectory_error(errors, visible) == np.inf
    visible[2:] = False
    assert mean_trajectory_error(errors, visible) == 1
