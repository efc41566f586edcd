"""The measures of a reconstruction against its capture, on plates whose motion is known."""

import dataclasses
import types

import numpy as np
import pytest
from plates import FRAMES, HEIGHT, TEST, WIDTH, Perfect, Slow, plates, write_capture

from scas4d_core.captures import open_capture
from scas4d_core.metrics import evaluation as measures


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("captures") / "plates")


def test_a_perfect_reconstruction_scores_perfectly(capture_folder, tmp_path):
    scene = Perfect.start(None, None, None)
    for t in range(1, FRAMES):
        scene.step(types.SimpleNamespace(index=t))
    capture = open_capture(capture_folder)
    mean, by_camera = measures.measure_pictures(scene, capture, 2)
    assert set(by_camera) == set(TEST)
    assert mean["psnr"] > 80  # colours are multiples of 3/255, so the file holds them exactly
    assert mean["ssim"] > 0.9999
    assert mean["psnr_changed"] > 80
    tracks = measures.measure_tracks(scene, capture, range(FRAMES))
    assert tracks["track_3d_median"] < 1e-3
    assert tracks["track_points"] == 100
    assert tracks["visibility_accuracy"] > 0.99
    assert tracks["mte_2d_oracle"] < 0.01
    assert tracks["mte_2d"] < 0.1
    assert measures.measure_parts(scene, capture, range(FRAMES)) == {
        "parts_ari": 1.0, "parts_count": 2.0, "parts_ari_found": 1.0, "parts_count_found": 2.0,
    }  # fmt: skip


def test_static_true_parts_count_as_one_if_no_number_is_given(capture_folder):
    scene = Perfect.start(None, None, None)
    for t in range(1, FRAMES):
        scene.step(types.SimpleNamespace(index=t))
    capture = open_capture(capture_folder)
    static = tuple(dataclasses.replace(part, static=True) for part in capture.ground_truth.parts)
    truth = dataclasses.replace(capture.ground_truth, parts=static)
    scores = measures.measure_parts(scene, dataclasses.replace(capture, ground_truth=truth), range(FRAMES))
    assert (scores["parts_ari"], scores["parts_ari_found"]) == (1.0, 0.0)  # one true part, but two are found


def test_half_the_motion_is_half_the_error(capture_folder):
    scene = Slow.start(None, None, None)
    for t in range(1, FRAMES):
        scene.step(types.SimpleNamespace(index=t))
    capture = open_capture(capture_folder)
    tracks = measures.measure_tracks(scene, capture, range(FRAMES))
    moved = np.linalg.norm(np.stack([plates(t) - plates(0) for t in range(1, FRAMES)]), axis=-1)[:, [0, -1]]
    assert tracks["track_3d_median"] == pytest.approx(np.median(moved) / 2 / 1.2 * 100, rel=0.05)
    assert tracks["track_3d_last"] == pytest.approx(np.median(moved[-1]) / 2 / 1.2 * 100, rel=0.05)
    pixels = 60 / 3 * np.median(moved, axis=0) / 2
    assert tracks["mte_2d"] == pytest.approx(pixels.mean() / np.hypot(WIDTH, HEIGHT) * 100, rel=0.25)
    assert tracks["mte_2d"] > tracks["mte_2d_oracle"] > 0.05


def test_standing_points_do_not_flatter_the_error():
    points = np.zeros((3, 2, 3))
    points[2, 0, 1] = 0.02
    assert measures.moving_points(points, 1.0).tolist() == [True, False]
    assert measures.moving_points(points, 2.5).tolist() == [False, False]


def test_flicker_is_told_of_pixels_that_show_something_and_stand(monkeypatch):
    rng = np.random.default_rng(0)
    true = np.zeros((4, 60, 40, 3), np.uint8)
    true[:, :, :20] = 120
    true[1::2, :10, :20] = 160  # changes
    shown = true / 255.0
    shown[:, 10:, :20] += rng.choice([-4, 4], size=(4, 1, 1, 1)) / 255  # all still pixels up and down alike
    shown[1:, :, 30:] = 0.5  # where nothing is, nothing counts
    camera = types.SimpleNamespace(name="a")
    capture = types.SimpleNamespace(
        test_rig=types.SimpleNamespace(cameras=[camera]),
        test_frame=lambda index: types.SimpleNamespace(images={"a": true[index]}),
    )
    scene = types.SimpleNamespace(render=lambda camera, index: types.SimpleNamespace(colour=shown[index]))
    found = measures.measure_flicker(scene, capture, range(4))
    assert found["still_pixels"] == 50 * 20
    assert found["flicker"] == pytest.approx((255 * shown[:, 30, 5, 0]).std())
    assert found["mtv"] == pytest.approx(100 * np.abs(np.diff(shown[:, 30, 5, 0])).mean())
    assert found["mtv"] > 1
    monkeypatch.setattr(measures, "MIN_STILL", 1001)
    few = measures.measure_flicker(scene, capture, range(4))
    assert few["flicker"] is None
    assert few["mtv"] is None
