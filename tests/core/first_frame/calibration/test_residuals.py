"""Residuals of cameras: right rigs are clean, faults are told of the camera that has them, chance is not believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_rigs import matches as made_matches

from scas4d_core.first_frame.calibration.matches import epipolar_distances
from scas4d_core.first_frame.calibration.residuals import MIN_INLIERS, estimate_residual, measure_residuals

RING = made_matches.ring()


@pytest.fixture(scope="module")
def matches():
    return made_matches.matches_of(RING)


def test_a_right_rig_is_clean(matches):
    cameras, off = measure_residuals(matches)
    assert off == []
    assert max(found.pixels for found in cameras.values()) < 0.4
    assert min(found.matches for found in cameras.values()) > 100


@pytest.mark.parametrize("pixels", [2, 4, 8])
def test_a_turned_camera_is_told_and_its_neighbours_are_not(matches, pixels):
    cameras = [made_matches.turned(camera, pixels) if camera.name == "c3" else camera for camera in RING]
    found, off = measure_residuals(matches.with_cameras(cameras))
    assert off == ["c3"]
    assert 0.4 * pixels < found["c3"].pixels <= 1.15 * pixels  # fy is 1.1 fx
    assert max(found[camera.name].pixels for camera in RING if camera.name != "c3") < 0.5


def test_two_turned_cameras_are_told(matches):
    cameras = [made_matches.turned(camera, 3) if camera.name in ("c3", "c4") else camera for camera in RING]
    assert measure_residuals(matches.with_cameras(cameras))[1] == ["c3", "c4"]


def test_where_all_are_off_none_is_named(matches):
    rng = np.random.default_rng(3)
    cameras = [made_matches.turned(camera, 4, rng.normal(size=3)) for camera in RING]
    found, off = measure_residuals(matches.with_cameras(cameras))
    assert off == []
    assert np.median([camera.pixels for camera in found.values()]) > 1.5


def test_pixels_are_those_of_the_pictures_that_came(matches):
    small, large = measure_residuals(matches)[0], measure_residuals(replace(matches, scale=2 * matches.scale))[0]
    assert large["c0"].pixels == 2 * small["c0"].pixels


def test_wrong_matches_do_not_shift_the_median():
    rng = np.random.default_rng(0)
    right, wrong = np.abs(rng.normal(size=4000)) * 0.5, rng.uniform(0, 80, 4000)
    median, least, count = estimate_residual(np.concatenate([right, wrong]))
    assert median == pytest.approx(np.median(right), rel=0.1)
    assert 0.9 * median < least < median
    assert count == pytest.approx(4000, rel=0.05)


@pytest.mark.parametrize("distances", [np.zeros(0), np.full(MIN_INLIERS - 1, 0.3), np.linspace(0, 80, 500)])
def test_of_few_matches_and_of_chance_nothing_is_claimed(distances):
    assert np.isnan(estimate_residual(distances).median)


def test_a_camera_of_which_many_matches_are_near_is_not_named(matches):
    """Things that repeat, as the turns of a spring, have wrong matches beside the right ones."""
    rng = np.random.default_rng(0)
    some = np.concatenate([np.abs(rng.normal(size=16)) * 0.2, rng.uniform(0.8, 4, 19)])
    assert estimate_residual(some).median > 0.9 > estimate_residual(some).lower_bound


def test_distances_are_those_to_the_epipolar_lines(matches):
    """A match moved across its epipolar line by a pixel is a pixel off, in the picture where that is more."""
    exact = made_matches.matches_of(RING, noise=0.0, wrong=0.0)
    pair = next(iter(exact.pairs))
    assert epipolar_distances(exact, pair).max() < 1e-9
    shifted = [uv + np.array([0.0, 1.0]) * (index == pair[1]) for index, uv in enumerate(exact.pixels)]
    distances = epipolar_distances(replace(exact, pixels=shifted), pair)
    assert 0.5 < np.median(distances) <= 1.2


def test_halves_share_no_feature(matches):
    learnt, held = matches.split()
    features = [
        {(v, int(row)) for pair, rows in part.pairs.items() for k, v in enumerate(pair) for row in rows[:, k]}
        for part in (learnt, held)
    ]
    assert features[0]
    assert features[1]
    assert not features[0] & features[1]
    count = [sum(map(len, part.pairs.values())) for part in (matches, learnt, held)]
    assert count[0] == count[1] + count[2]
