"""The calibration of the sample, right and disturbed: measured, refined on request, refused where nothing is gained."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from made_rigs import matches as made_matches

from scas4d_core.cameras import Rig
from scas4d_core.captures import open_capture
from scas4d_core.first_frame.calibration import refine
from scas4d_core.first_frame.calibration.matches import match_by_appearance
from scas4d_core.first_frame.calibration.refine import check_calibration, refine_rig
from scas4d_core.first_frame.calibration.report import effective_rig
from scas4d_core.frame_report import FrameReport
from scas4d_core.posed_pictures import collect_views
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

pytestmark = pytest.mark.slow

FAULT_PX = 3.0


@pytest.fixture(scope="module")
def sample():
    return open_capture("samples/robot")


@pytest.fixture(scope="module")
def images(sample):
    return dict(sample.frame(0).images)


@pytest.fixture(scope="module")
def disturbed(sample):
    """The rig with its third camera turned by three pixels."""
    cameras = sample.rig.cameras
    return Rig((*cameras[:2], made_matches.turned(cameras[2], FAULT_PX), *cameras[3:]))


@pytest.fixture(scope="module")
def refined(disturbed, images):
    return check_calibration(disturbed, images, refine=True)


def test_a_right_calibration_is_told_and_left_as_it_is(sample, images):
    found = check_calibration(sample.rig, images, refine=True)
    assert found.miscalibrated == []
    assert max(camera.pixels for camera in found.cameras.values() if np.isfinite(camera.pixels)) < 0.6
    assert not found.refined.accepted
    assert found.refined.cameras == {}
    rig = sample.rig
    assert effective_rig(rig, {"calibration": asdict(found)}) is rig


def test_a_turned_camera_is_named_and_nothing_is_refined_unasked(disturbed, images):
    found = check_calibration(disturbed, images, refine=False)
    third = disturbed.names[2]
    assert found.miscalibrated == [third]
    assert found.cameras[third].pixels > 1
    assert found.refined is None
    (said,) = found.warnings
    assert f"camera {third!r}" in said
    assert "static.refine_calibration" in said


def test_a_turned_camera_turns_back_and_the_others_stay(sample, disturbed, refined):
    assert refined.refined.accepted
    rig = effective_rig(disturbed, FrameReport(0, 0.0, 0, {}, [], 0.0, 0, 0, calibration=refined).record())
    centre = sample.points.positions.mean(0)
    off = [
        np.linalg.norm(true.project(centre)[0] - found.project(centre)[0])
        for true, found in zip(sample.rig.cameras, rig.cameras, strict=True)
    ]
    assert max(off) < 0.5
    third = refined.refined.cameras[disturbed.names[2]]
    assert third.rotation_deg > 0.1  # of 0.4°: what is small in the picture meets a shift as well as a turn
    assert third.after < 0.5 < third.before
    assert refined.refined.after < refined.refined.before
    assert "refined as requested" in refined.warnings[0]
    assert len(refined.warnings) == 1  # nothing is off any more


def test_cameras_with_few_matches_stay_as_they_are(sample, disturbed, images):
    """One that sees nothing but grey has none."""
    blind = {**images, disturbed.names[5]: np.full_like(images[disturbed.names[5]], 128)}
    found = check_calibration(disturbed, blind, refine=True).refined
    assert found.accepted
    assert found.cameras[disturbed.names[5]].fixed
    assert found.cameras[disturbed.names[5]].pose == disturbed.cameras[5].world_to_camera.tolist()
    assert f"cameras with too few matches are unchanged: {disturbed.names[5]}" in found.text


def test_what_matches_held_out_do_not_bear_out_is_refused(disturbed, images, monkeypatch):
    """An adjustment that makes it worse is not taken."""
    matches = match_by_appearance(collect_views(disturbed, images, {}))
    worse = lambda cameras, tracks, **_: [made_matches.turned(camera, 2) for camera in cameras]  # noqa: E731
    monkeypatch.setattr(refine, "bundle_adjust", worse)
    found = refine_rig(disturbed, matches)
    assert not found.accepted
    assert "held-out matches did not decrease" in found.text


@pytest.mark.parametrize(("one", "other"), [("0", "1"), ("5", "16"), ("1", "12")])
def test_exchanged_images_are_named_and_the_calibration_is_not_blamed(sample, images, one, other):
    swapped = {**images, one: images[other], other: images[one]}
    (said,) = check_calibration(sample.rig, swapped, refine=False).warnings
    assert said.startswith(f"the images of cameras {one!r} and {other!r} seem to be exchanged")
    assert "calibration" not in said


def test_what_all_images_show_precedes_what_may_be_wrong(sample, images):
    frame = replace(sample.frame(0), images=dict.fromkeys(images, images["0"]), masks={})
    said = refine.calibrate_first_frame(
        sample.rig, frame, Settings().static, lambda progress: None, measured=True
    ).warnings
    assert said[0].startswith(f"all {len(images)} images are identical (0, 1, 2, 3, 5, 6, 7, 9 and 8 more)")
    assert said[1].startswith("matching features are ")


def test_two_cameras_are_not_refined(sample, images):
    rig = Rig(sample.rig.cameras[:2])
    found = check_calibration(rig, images, refine=True)
    assert not found.refined.accepted
    assert "cameras have" in found.refined.text


def test_of_one_picture_nothing_is_told(sample, images):
    name = sample.rig.names[0]
    assert check_calibration(sample.rig, {name: images[name]}, refine=True) is None


def test_pictures_of_nothing_give_nothing(sample, images):
    found = check_calibration(sample.rig, {n: np.zeros_like(i) for n, i in images.items()}, refine=True)
    assert found.warnings == [found.refined.text]
    assert all(np.isnan(camera.pixels) and camera.matches == 0 for camera in found.cameras.values())


def test_large_pictures_are_measured_smaller_and_told_in_their_pixels(sample, disturbed, images, refined):
    large = {name: image.repeat(4, 0).repeat(4, 1) for name, image in images.items()}
    found = check_calibration(disturbed.scaled(4), large, refine=False)
    third = disturbed.names[2]
    assert found.miscalibrated == [third]
    assert found.cameras[third].pixels == pytest.approx(4 * refined.refined.cameras[third].before, rel=0.5)


FEW = {"scene": {"image_scale": 0.25}, "static": {"iterations": 5, "max_gaussians": 500}, "update": {"iterations": 4}}
ASKED = Settings.model_validate({**FEW, "static": {**FEW["static"], "refine_calibration": True}})


def test_a_scene_goes_on_with_the_rig_that_frame_0_refined(sample, disturbed, tmp_path):
    """After a crash, and aside: the same cameras bit for bit, whatever the settings say then."""
    scene = Reconstruction.start(
        disturbed, sample.frame(0), ASKED, points=sample.points, history=History(tmp_path / "states")
    )
    assert scene.report.calibration.refined.accepted
    assert scene.report.seconds["calibration"] > 0
    third = disturbed.names[2]
    assert not np.array_equal(scene.calibrated[third].world_to_camera, disturbed[third].world_to_camera)
    report = scene.step(sample.frame(1))
    again = Reconstruction.resume(disturbed, Settings.model_validate(FEW), History.open(tmp_path / "states"))
    aside = Reconstruction.fork(disturbed, ASKED, History.open(tmp_path / "states"), 0)
    for other in (again, aside):
        assert np.array_equal(other.world.origin, scene.world.origin)
        for ours, theirs in zip(scene.rig.cameras, other.rig.cameras, strict=True):
            assert np.array_equal(ours.world_to_camera, theirs.world_to_camera)
            assert np.array_equal(ours.intrinsics, theirs.intrinsics)
    aside.step(sample.frame(1))
    assert aside.report.outcome == report.outcome
    scene.step(sample.frame(2))
    again.step(sample.frame(2))
    assert np.array_equal(scene.history.gaussians(2).means, again.history.gaussians(2).means)


def test_without_asking_the_rig_and_the_states_are_as_they_were(sample, disturbed, monkeypatch):
    """Measuring changes no bit."""
    settings = Settings.model_validate(FEW)
    measured = Reconstruction.start(disturbed, sample.frame(0), settings, points=sample.points)
    assert measured.report.calibration.miscalibrated == [disturbed.names[2]]
    assert measured.calibrated is disturbed
    monkeypatch.setattr("scas4d_core.reconstruction.calibrate_first_frame", lambda *_, **__: None)
    not_measured = Reconstruction.start(disturbed, sample.frame(0), settings, points=sample.points)
    assert not_measured.report.calibration is None
    assert np.array_equal(measured.history.gaussians(0).means, not_measured.history.gaussians(0).means)


def test_a_frame_0_that_is_given_is_not_measured_unless_it_is_to_be_refined(sample, disturbed):
    settings = Settings.model_validate(FEW)
    static = Reconstruction.start(disturbed, sample.frame(0), settings, points=sample.points).static
    assert Reconstruction.start(disturbed, sample.frame(0), settings, static=static).report.calibration is None
    assert Reconstruction.start(disturbed, sample.frame(0), ASKED, static=static).report.calibration is not None


def test_the_record_of_a_report_reads_back(refined):
    record = FrameReport(0, 0.0, 0, {}, [], 0.0, 0, 0, calibration=replace(refined)).record()
    assert record["calibration"]["refined"]["cameras"].keys() == refined.refined.cameras.keys()
