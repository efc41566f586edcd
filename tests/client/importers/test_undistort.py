"""Distortion undone: painted dots land where the pinhole says, for every model, against lenses written here anew."""

from __future__ import annotations

import re

import numpy as np
import pytest
from lenses import HEIGHT, LENSES, WIDTH, camera, distorted, dot_at, painted, pose, seen

from client.importers.extras import MissingExtraError, load
from client.importers.lens import MODELS, lens_camera
from client.importers.undistort import Undistorter, undistort_pixels
from scas4d_core.captures import CaptureError

pytest.importorskip("cv2")


def points_before(pinhole, count=14, margin=12, seed=0):
    """World points that the pinhole sees, far enough from one another for their dots to stay apart."""
    generator = np.random.default_rng(seed)
    chosen = []
    while len(chosen) < count:
        uv = generator.uniform([margin, margin], [WIDTH - margin, HEIGHT - margin])
        if all(np.linalg.norm(uv - other) > 30 for other in chosen):
            chosen.append(uv)
    return pinhole.unproject(np.array(chosen), generator.uniform(2, 4, count))


def test_every_model_is_tried():
    assert set(LENSES) == set(MODELS)


@pytest.mark.parametrize("model", LENSES)
def test_painted_dots_land_where_the_pinhole_projects_them(model):
    lens = camera(model)
    undistorter = Undistorter(lens)
    pinhole = undistorter.camera
    points = points_before(pinhole)
    dots = seen(lens, points)
    picture = undistorter.picture(painted(dots))
    expected, _ = pinhole.project(points)
    # A round dot of the lens is not quite round afterwards, and its centroid a little off. How much, is found from the
    # same dots looked at through the lens pixel by pixel, without any interpolation.
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = (np.stack([u, v], -1).reshape(-1, 2) - pinhole.intrinsics[:2, 2]) / pinhole.intrinsics.diagonal()[:2]
    ideal = painted(dots, at=distorted(model, LENSES[model], rays).reshape(HEIGHT, WIDTH, 2))
    found = np.array([dot_at(picture, uv) for uv in expected])
    there = np.array([dot_at(ideal, uv) for uv in expected])
    assert np.linalg.norm(found - there, axis=1).max() < 0.03
    assert np.linalg.norm((found - there).mean(axis=0)) < 0.005
    assert np.linalg.norm(found - expected, axis=1).max() < 0.15


@pytest.mark.parametrize("model", LENSES)
def test_no_pixel_was_made_up_and_the_largest_such_picture_was_taken(model):
    lens = camera(model)
    undistorter = Undistorter(lens)
    assert undistorter.valid.shape == (HEIGHT, WIDTH)
    assert undistorter.valid.all()
    assert (undistorter.camera.width, undistorter.camera.height) == (WIDTH, HEIGHT)
    ratio = undistorter.camera.fy / undistorter.camera.fx
    assert ratio == pytest.approx(lens.intrinsics[1, 1] / lens.intrinsics[0, 0])
    if not lens.is_pinhole:
        wider = np.diag([0.97, 0.97, 1]) @ undistorter.camera.intrinsics
        wider[:2, 2] = undistorter.camera.intrinsics[:2, 2] * 0.97 + [0.015 * WIDTH, 0.015 * HEIGHT]
        corners = np.array([[0.0, 0], [WIDTH / 2, 0], [WIDTH, 0], [0, HEIGHT / 2], [WIDTH, HEIGHT / 2]])
        corners = np.concatenate([corners, corners * [1, 0] + [0, HEIGHT]])
        rays = (corners - wider[:2, 2]) / wider.diagonal()[:2]
        at = distorted(model, LENSES[model], rays)
        assert ((at < 0) | (at > [WIDTH, HEIGHT])).any(), "a picture 3% wider would have been seen whole too"


@pytest.mark.parametrize("model", [model for model in LENSES if "PINHOLE" not in model])
def test_rays_of_pixels_go_back_to_them(model):
    lens = camera(model)
    pixels = np.random.default_rng(1).uniform([0, 0], [WIDTH, HEIGHT], (200, 2))
    rays = undistort_pixels(lens, pixels)
    assert np.abs(distorted(model, LENSES[model], rays) - pixels).max() < 1e-3


def test_half_a_pixel_matters():
    """What the shift is for: with OpenCV's pixels taken for ours, dots lie beside by a part of half a pixel."""
    lens = camera("OPENCV_FISHEYE")
    undistorter = Undistorter(lens)
    points = points_before(undistorter.camera)
    wrong = lens_camera(
        "c0",
        lens.model,
        LENSES[lens.model] | {"cx": 158.8, "cy": 122.4},
        lens.world_to_camera,
        (WIDTH, HEIGHT),
        source="",
    )
    picture = undistorter.picture(painted(seen(wrong, points)))
    expected, _ = undistorter.camera.project(points)
    errors = [np.linalg.norm(dot_at(picture, uv) - uv) for uv in expected]
    assert min(errors) > 0.2


def test_a_picture_of_the_lens_stays_sharp():
    """An edge is as steep after as before, within the interpolation's reach."""
    lens = camera("SIMPLE_RADIAL")
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, WIDTH // 2 :] = 200
    row = Undistorter(lens).picture(picture)[HEIGHT // 2, :, 0].astype(int)
    assert ((row > 20) & (row < 180)).sum() <= 2


def test_masks_keep_their_labels():
    lens = camera("OPENCV")
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[60:180, 80:240] = 255
    undone = Undistorter(lens).mask(mask)
    assert set(np.unique(undone)) == {0, 255}


def test_a_fisheye_beyond_a_half_sphere_gives_the_widest_pinhole():
    lens = camera("OPENCV_FISHEYE", fx=85.0, fy=85.0, k1=0.0, k2=0.0, k3=0.0, k4=0.0)  # 216° across
    undistorter = Undistorter(lens)
    assert 2 * np.degrees(np.arctan(WIDTH / 2 / undistorter.camera.fx)) <= 120.01
    assert undistorter.valid.all()
    points = points_before(undistorter.camera, count=8, margin=30)
    picture = undistorter.picture(painted(seen(lens, points), sigma=1.2))
    expected, _ = undistorter.camera.project(points)
    assert max(np.linalg.norm(dot_at(picture, uv, 9) - uv) for uv in expected) < 0.25


TURNING = [
    ("SIMPLE_RADIAL", {"k1": -0.3}),
    ("RADIAL", {"k1": 0.1, "k2": -0.5}),
    ("OPENCV", {"k1": -0.3, "k2": 0.01}),
    ("OPENCV_FISHEYE", {"k1": -0.3}),
    ("FULL_OPENCV", {"k2": -0.6, "k4": 0.5}),
]


@pytest.mark.parametrize(("model", "changes"), TURNING)
def test_a_lens_that_turns_back_towards_the_corners_is_cut_and_says_so(model, changes):
    lens, parameters = camera(model, **changes), LENSES[model] | changes
    undistorter = Undistorter(lens)
    corners = np.array([[0.0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]])
    assert np.isnan(undistort_pixels(lens, corners)).all(axis=1).any(), "its polynomial reaches every corner"
    # What it shows, it saw: towards the border of the pinhole, pixels of the lens go outwards without turning.
    pinhole = undistorter.camera
    x, y = np.linspace(0, WIDTH, 60), np.linspace(0, HEIGHT, 60)
    border = np.concatenate(
        [np.stack(np.broadcast_arrays(a, b), -1) for a, b in ((x, 0), (WIDTH, y), (x, HEIGHT), (0, y))]
    )
    rays = (border - pinhole.intrinsics[:2, 2]) / pinhole.intrinsics.diagonal()[:2]
    outwards = np.linspace(0.02, 1, 50)[:, None, None] * rays
    at = np.stack([distorted(model, parameters, one) for one in outwards])
    assert ((at > -0.02) & (at < [WIDTH + 0.02, HEIGHT + 0.02])).all()
    assert (np.diff(np.linalg.norm(at - lens.intrinsics[:2, 2], axis=-1), axis=0) > 0).all()
    assert undistorter.valid.all()
    # The share that is said to be lost, counted pixel by pixel.
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    back = undistort_pixels(lens, np.stack([u, v], -1).reshape(-1, 2))
    shown = back * pinhole.intrinsics.diagonal()[:2] + pinhole.intrinsics[:2, 2]
    lost = 1 - ((shown > 0) & (shown < [WIDTH, HEIGHT])).all(axis=1).mean()
    said = re.match(
        r"camera 'c0': its distortion is not monotonic .*; (\d+)% of its image is cropped", undistorter.remark
    )
    assert abs(int(said[1]) / 100 - lost) < 0.015
    points = points_before(pinhole)
    picture = undistorter.picture(painted(seen(lens, points)))
    for uv in pinhole.project(points)[0]:
        assert np.linalg.norm(dot_at(picture, uv) - uv) < 0.4  # far out, round dots are no longer round


@pytest.mark.parametrize("model", [model for model in LENSES if "PINHOLE" not in model])
def test_a_lens_that_rises_everywhere_is_not_cut(model):
    assert Undistorter(camera(model)).remark is None


@pytest.mark.parametrize(
    ("model", "changes"), [("SIMPLE_RADIAL", {"k1": -0.9}), ("FULL_OPENCV", {"k4": 9.0, "k5": 40.0})]
)
def test_a_lens_of_which_little_is_left_is_refused(model, changes):
    with pytest.raises(CaptureError, match=r"'c0': its distortion .* folds .* only \d+% .* calibrate"):
        _ = Undistorter(camera(model, **changes)).camera


def test_a_straight_lens_is_left_alone():
    lens = camera("PINHOLE")
    picture = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    assert Undistorter(lens).picture(picture) is picture
    assert np.array_equal(Undistorter(lens).camera.intrinsics, lens.intrinsics)


def test_a_picture_of_another_size_is_refused():
    with pytest.raises(CaptureError, match=r"c0.*10x10.*320x240"):
        Undistorter(camera("OPENCV")).picture(np.zeros((10, 10, 3), np.uint8))


@pytest.mark.parametrize(
    ("model", "changes", "said"),
    [
        ("FOV", {}, "unsupported model FOV; calibrate with one of SIMPLE_PINHOLE"),
        ("SIMPLE_RADIAL", {"k2": 0.1}, "k2 = 0.1, which model SIMPLE_RADIAL does not support"),
        ("PINHOLE", {"fx": -1.0}, "focal lengths must be positive, got -1"),
        ("OPENCV", {"k1": float("nan")}, "k1 must be finite"),
        ("OPENCV", {"cx": float("inf")}, "NaN or infinity"),
    ],
)
def test_what_cannot_be_a_camera_is_named(model, changes, said):
    parameters = LENSES.get(model, LENSES["PINHOLE"]) | changes
    with pytest.raises(CaptureError, match="rig.json.*" + said):
        lens_camera("c0", model, parameters, pose(), (WIDTH, HEIGHT), source="rig.json")


def test_a_missing_package_names_the_extra():
    with pytest.raises(
        MissingExtraError, match=r"opening boxes requires no_such_box.*pip install -e '\.\[importers\]'"
    ):
        load("no_such_box", needed="opening boxes")
