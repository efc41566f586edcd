import math

import numpy as np
import pytest

from scas4d_core.metrics import (
    calibration_error,
    error_by_confidence,
    lost_parts,
    median_trajectory_error,
    oracle_tracks,
    track_error_3d,
    visibility_accuracy,
)


def test_mte_is_the_mean_over_tracks_of_medians_over_frames():
    truth = np.zeros((4, 2, 2))
    tracks = truth.copy()
    tracks[:, 0, 0] = [77, 1, 2, 9]  # frame 0 is the query: median of 1, 2, 9
    tracks[:, 1, 1] = [77, 4, 4, 4]
    counted = np.ones((4, 2), bool)
    assert median_trajectory_error(tracks, truth, counted, diagonal=200.0) == pytest.approx(100 * (2 + 4) / 2 / 200)


def test_mte_counts_visible_frames_and_takes_a_lost_track_for_a_diagonal():
    truth = np.zeros((4, 3, 2))
    tracks = truth.copy()
    tracks[:, 0, 0] = [0, 1, 2, 90]
    tracks[1:, 1] = np.nan
    tracks[:, 2] = 50
    counted = np.ones((4, 3), bool)
    counted[3, 0] = False  # the error of 90 px is hidden
    counted[1:, 2] = False  # never seen again: left out
    assert median_trajectory_error(tracks, truth, counted, diagonal=100.0) == pytest.approx((1.5 + 100) / 2)
    assert math.isnan(median_trajectory_error(tracks, truth, np.zeros((4, 3), bool), diagonal=100.0))
    assert counted[0].all(), "the caller's array is left alone"


def test_the_oracle_takes_the_best_within_ten_pixels_and_else_the_nearest():
    truth = np.zeros((3, 2, 2))
    truth[:, 0] = [[50, 50], [60, 50], [70, 50]]
    truth[:, 1] = [[200, 200]] * 3
    candidates = np.empty((3, 4, 2))
    candidates[:, 0] = [[50, 50], [50, 50], [50, 50]]  # nearest, but stands still
    candidates[:, 1] = [[58, 50], [61, 50], [71, 50]]  # 8 px off at first, then right
    candidates[:, 2] = [[61, 50], [60, 50], [70, 50]]  # perfect, but 11 px off at first
    candidates[:, 3] = np.nan  # behind the camera
    chosen = oracle_tracks(candidates, truth, np.ones((3, 2), bool))
    np.testing.assert_array_equal(chosen[:, 0], candidates[:, 1])
    np.testing.assert_array_equal(chosen[:, 1], candidates[:, 2])


def test_the_oracle_does_not_look_at_what_does_not_count():
    truth = np.zeros((3, 1, 2))
    candidates = np.zeros((3, 2, 2))
    candidates[:, 0, 0] = [0, 2, 0]
    candidates[:, 1, 0] = [0, 1, 90]
    counted = np.array([[True], [True], [False]])
    np.testing.assert_array_equal(oracle_tracks(candidates, truth, counted)[:, 0], candidates[:, 1])


def test_3d_error_pools_moving_points_over_all_frames_but_the_query():
    truth = np.zeros((3, 3, 3))
    tracks = truth.copy()
    tracks[0] = 99
    tracks[1:, 0, 0] = [0.1, 0.3]
    tracks[1:, 1, 2] = [0.2, 0.4]
    tracks[1:, 2] = 99  # stands still
    error = track_error_3d(tracks, truth, np.array([True, True, False]), extent=2.0)
    assert (error.median, error.percentile_90, error.count) == (pytest.approx(12.5), pytest.approx(20.0), 4)


def test_3d_error_of_lost_points_is_infinite_where_they_weigh():
    truth = np.zeros((11, 1, 3))
    tracks = truth.copy()
    tracks[9:] = np.nan
    error = track_error_3d(tracks, truth, np.array([True]), extent=1.0)
    assert (error.median, error.percentile_90) == (0.0, math.inf)


def test_errors_sorted_by_confidence():
    truth = np.zeros((3, 5, 3))
    tracks = truth.copy()
    tracks[1:, :4, 0] = [[1, 2, 3, 4], [5, 6, 7, 8]]
    tracks[0] = 99  # the query's frame
    tracks[:, 4] = 50  # stands
    confidence = np.zeros((3, 5))
    confidence[1:, :4] = 1 / tracks[1:, :4, 0]
    confidence[:, 4] = confidence[0] = 2
    moving = np.array([True, True, True, True, False])
    assert error_by_confidence(tracks, truth, confidence, moving, 100.0) == [1.5, 3.5, 5.5, 7.5]
    assert error_by_confidence(tracks, truth, -confidence, moving, 100.0, groups=2) == [6.5, 2.5]
    tracks[1, 0] = np.nan
    assert error_by_confidence(tracks, truth, confidence, moving, 100.0, groups=2) == [3.5, 6.5]
    with pytest.raises(ValueError, match=r"confidence must have shape .* got \(5,\)"):
        error_by_confidence(tracks, truth, confidence[0], moving, 100.0)


def test_visibility_accuracy_leaves_the_query_frame_out():
    truth = np.array([[True, True], [True, False]])
    assert visibility_accuracy(np.array([[False, False], [True, True]]), truth) == 0.5
    assert visibility_accuracy(np.array([[False, False], [True, False]]), truth) == 1.0


def test_faults_are_named():
    truth = np.zeros((3, 2, 2))
    with pytest.raises(ValueError, match="must both have shape"):
        median_trajectory_error(np.zeros((3, 2, 3)), truth, np.ones((3, 2), bool), 10.0)
    with pytest.raises(ValueError, match="diagonal"):
        median_trajectory_error(truth, truth, np.ones((3, 2), bool), 0.0)
    with pytest.raises(ValueError, match="no candidate"):
        oracle_tracks(np.full((3, 2, 2), np.nan), truth, np.ones((3, 2), bool))
    with pytest.raises(ValueError, match="extent"):
        track_error_3d(np.zeros((3, 2, 3)), np.zeros((3, 2, 3)), np.ones(2, bool), 0.0)
    with pytest.raises(ValueError, match="no point moves"):
        track_error_3d(np.zeros((3, 2, 3)), np.zeros((3, 2, 3)), np.zeros(2, bool), 1.0)


def test_a_part_is_lost_by_its_own_moving_points_in_the_last_frame() -> None:
    truth = np.zeros((3, 6, 3))
    parts, moving = np.array([1, 1, 1, 2, 2, 3]), np.array([True, True, True, True, False, False])
    off = np.array([0.0, 0.1, 0.9, 0.3, 0.0, 9.0])  # of an extent of 10: 2% are 0.2
    tracks = truth.copy()
    tracks[2, :, 0] = off
    assert lost_parts(tracks, truth, parts, moving, 10.0) == [2]  # of part 1 most are near; part 3 stands
    tracks[1, :, 0], tracks[2, :, 0] = off, 0.0
    assert lost_parts(tracks, truth, parts, moving, 10.0) == []  # found again
    tracks[2, 0:2] = np.nan
    assert lost_parts(tracks, truth, parts, moving, 10.0) == [1]


def test_calibration_error_is_that_of_its_definition():
    rng = np.random.default_rng(1)
    confidence = rng.random((5, 200))
    right = rng.random((5, 200)) < confidence**2
    expected = 0.0
    for low in np.arange(10) / 10:
        inside = (confidence >= low) & (confidence < low + 0.1)
        expected += inside.mean() * abs(confidence[inside].mean() - right[inside].mean())
    assert calibration_error(confidence, right) == pytest.approx(expected)
    assert calibration_error(confidence, rng.random((5, 200)) < confidence) < 0.5 * expected
    assert calibration_error(np.ones(4), np.ones(4, bool)) == 0  # 1 belongs to the last bin
    assert np.isnan(calibration_error(np.empty(0), np.empty(0, bool)))
    with pytest.raises(ValueError, match="same shape"):
        calibration_error(confidence, right[0])
