"""Bundle adjustment corrects faults and keeps correct cameras; the prior is in pixels."""

from __future__ import annotations

import numpy as np
import pytest
from made_rigs import matches as made_matches

from scas4d_core.first_frame.calibration import bundle
from scas4d_core.first_frame.calibration.bundle import build_tracks, bundle_adjust

RING = made_matches.ring()


@pytest.fixture(scope="module")
def tracks():
    return build_tracks(made_matches.matches_of(RING))


def test_tracks_have_each_camera_once(tracks):
    assert len(tracks) > 50
    assert all(len(set(who)) == len(who) == len(uv) > 1 for who, uv in tracks)


def test_a_right_rig_stays(tracks):
    assert made_matches.off_by(RING, bundle_adjust(RING, tracks)).max() < 0.25  # the noise of a feature


@pytest.mark.parametrize("pixels", [1, 4, 10])
def test_a_turned_camera_turns_back_and_takes_no_other_along(tracks, pixels):
    given = [made_matches.turned(camera, pixels, (0.6, 0.8, 0)) if camera.name == "c3" else camera for camera in RING]
    assert made_matches.off_by(RING, given).max() > 0.9 * pixels
    assert made_matches.off_by(RING, bundle_adjust(given, tracks)).max() < 0.25


def test_a_rig_that_is_off_all_over_is_mended_but_for_its_world(tracks):
    """The common turn of all cameras is nothing that pictures tell; these have none."""
    rng = np.random.default_rng(5)
    turns = rng.normal(size=(len(RING), 3)) * (1, 1, 0)
    given = [made_matches.turned(c, 1, c.rotation @ turn) for c, turn in zip(RING, turns - turns.mean(0), strict=True)]
    before, after = made_matches.off_by(RING, given), made_matches.off_by(RING, bundle_adjust(given, tracks))
    assert np.median(after) < 0.5 * np.median(before)


def test_a_focal_length_is_found_where_it_is_asked_for(tracks):
    given = [made_matches.longer(camera, 1.03) if camera.name == "c3" else camera for camera in RING]
    found = bundle_adjust(given, tracks, focal=True)
    assert found[3].fx == pytest.approx(RING[3].fx, rel=3e-3)
    assert found[3].fy / found[3].fx == pytest.approx(1.1)
    assert bundle_adjust(given, tracks)[3].fx == given[3].fx


def test_a_camera_without_tracks_stays_as_it_is(tracks):
    given = [made_matches.turned(camera, 4) if camera.name == "c3" else camera for camera in RING]
    without = [(who[who != 3], uv[who != 3]) for who, uv in tracks if (who != 3).sum() > 1]
    np.testing.assert_allclose(bundle_adjust(given, without)[3].world_to_camera, given[3].world_to_camera, atol=1e-12)


def test_the_same_matches_give_the_same_rig(tracks):
    first, second = bundle_adjust(RING, tracks), bundle_adjust(RING, tracks)
    assert all(np.array_equal(a.world_to_camera, b.world_to_camera) for a, b in zip(first, second, strict=True))


def test_units_and_the_origin_of_the_world_do_not_matter(tracks):
    """In millimetres, far from the origin, the same cameras turn by the same angles."""
    given = [made_matches.turned(camera, 3) if camera.name == "c3" else camera for camera in RING]
    elsewhere = [elsewhere_of(camera) for camera in given]
    here, there = bundle_adjust(given, tracks), bundle_adjust(elsewhere, tracks)
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a.rotation, b.rotation, atol=2e-5)
        np.testing.assert_allclose(b.centre / 1000 - (5, -7, 2), a.centre, atol=2e-4)


def elsewhere_of(camera):
    pose = camera.world_to_camera.copy()
    pose[:3, 3] = -camera.rotation @ (1000 * (camera.centre + np.array([5, -7, 2])))
    return made_matches.Camera(camera.name, camera.intrinsics, pose, camera.width, camera.height)


def test_the_prior_counts_the_pixels_by_which_a_camera_moves_what_it_sees():
    """A turn, a shift and a longer lens move what is seen by about as many pixels as the prior says."""
    depths = np.full(len(RING), 3.0)
    units = bundle._pixels_per_unit(RING, depths)
    for column in (0, 1, 3, 4):
        move = np.eye(6)[column] * 3 / units[0, column]
        moved = [bundle._moved(RING[0], move), *RING[1:]]
        np.testing.assert_allclose(made_matches.off_by(RING, moved), [3] + [0] * 8, atol=0.5)
    corner = RING[0].centre + RING[0].rotation.T @ [3 * RING[0].width / 4 / RING[0].fx, 0, 3]  # half-way to the edge
    longer = bundle._moved(RING[0], np.eye(7)[6] * 3 / units[0, 6])
    before, after = (camera.project(corner[None])[0] for camera in (RING[0], longer))
    np.testing.assert_allclose(after - before, [[3, 0]], atol=0.1)


def test_exact_features_turn_a_camera_back_exactly():
    """The prior of the turned camera leaves less than 0.02 px."""
    exact = build_tracks(made_matches.matches_of(RING, noise=0, wrong=0))
    given = [made_matches.turned(camera, 4) if camera.name == "c3" else camera for camera in RING]
    assert made_matches.off_by(RING, bundle_adjust(given, exact)).max() < 0.02
