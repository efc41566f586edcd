from __future__ import annotations

import numpy as np
import pytest
from lenses import LENSES
from rigs import lenses, transforms, write

from client.importers.formats.nerfstudio import read_transforms
from scas4d_core.captures import CaptureError

TURNED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
MIRRORED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 2], [0, 0, 0, 1]])


def read(path):
    return read_transforms([path], path.parent)


def assert_same(calibration, rig):
    assert calibration.names == ("cam1", "cam2", "cam10")
    for lens in calibration.cameras:
        was = rig[lens.name]
        assert np.allclose(lens.world_to_camera, was.world_to_camera, atol=1e-12)
        assert np.array_equal(lens.intrinsics, was.intrinsics)
        assert np.array_equal(lens.distortion, was.distortion)
        assert (lens.model, lens.width, lens.height) == (was.model, was.width, was.height)


@pytest.mark.parametrize("model", [model for model in LENSES if model != "FULL_OPENCV"])
@pytest.mark.parametrize("per_frame", [False, True])
def test_cameras_come_back(tmp_path, model, per_frame):
    rig = lenses(model)
    path = write(tmp_path / "transforms.json", transforms(rig, model, per_frame=per_frame))
    assert_same(read(path), rig)


@pytest.mark.parametrize("world", [TURNED, MIRRORED])
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_what_was_applied_to_the_world_is_undone(tmp_path, world, scale):
    rig = lenses()
    path = write(tmp_path / "transforms.json", transforms(rig, world=world, scale=scale))
    assert_same(read(path), rig)


def test_a_point_before_the_camera_in_opengl_is_before_it_here(tmp_path):
    """Written out once by hand: a camera at (0, 0, 4) looking along −z sees what is up above its middle."""
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
    meta = {
        "w": 100,
        "h": 80,
        "fl_x": 50,
        "cx": 50,
        "cy": 40,
        "frames": [{"file_path": "a.png", "transform_matrix": matrix}],
    }
    (lens,) = read(write(tmp_path / "t.json", meta)).cameras
    uv, depth = lens.pinhole().project([[1.0, 2.0, 0.0]])
    assert depth == pytest.approx([4])
    assert uv[0] == pytest.approx([50 + 50 / 4, 40 - 50 * 2 / 4])


def test_instant_ngp_gives_an_angle(tmp_path):
    meta = transforms(lenses("PINHOLE"), "PINHOLE", camera_angle_x=2 * np.arctan(160 / 200))
    del meta["fl_x"], meta["fl_y"]
    calibration = read(write(tmp_path / "transforms.json", meta))
    assert calibration.cameras[0].intrinsics[0, 0] == pytest.approx(200)
    assert calibration.cameras[0].intrinsics[1, 1] == pytest.approx(200)


def test_coefficients_without_a_model_mean_opencv(tmp_path):
    meta = transforms(lenses())
    del meta["camera_model"]
    assert read(write(tmp_path / "t.json", meta)).cameras[0].model == "OPENCV"


def test_instant_ngp_says_fisheye_in_its_own_way_and_windows_writes_paths_its_own_way(tmp_path):
    rig = lenses("OPENCV_FISHEYE")
    meta = transforms(rig, "OPENCV_FISHEYE", is_fisheye=True, path="./data\\{}\\0.jpg")
    del meta["camera_model"]
    assert_same(read(write(tmp_path / "t.json", meta)), rig)


def test_a_rig_over_time_has_one_camera_a_folder(tmp_path):
    rig = lenses()
    meta = transforms(rig, path="images/{}/f2.jpg")
    for t, frame in ((1.5, "f10"), (0.5, "f1")):
        more = transforms(rig, path=f"images/{{}}/{frame}.jpg")["frames"]
        meta["frames"] += [one | {"time": t} for one in more]
    for one in meta["frames"][:3]:
        one["time"] = 1.0
    calibration = read(write(tmp_path / "t.json", meta))
    assert_same(calibration, rig)
    assert [(view.path.stem, view.time) for view in calibration.views["cam1"]] == [
        ("f1", 0.5),
        ("f2", 1.0),
        ("f10", 1.5),
    ]


def change(document, path, value):
    *parts, last = path
    for part in parts:
        document = document[part]
    if value is None:
        del document[last]
    else:
        document[last] = value


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("frames",), None, "has no frames"),
        (("frames",), [], "has no frames"),
        (("frames", 1), 7, r"frames\[1\] must be an object"),
        (("frames", 1, "file_path"), None, r"frames\[1\]: missing file_path"),
        (("frames", 1, "transform_matrix"), [[1, 2], [3, 4]], "transform_matrix must be a 4x4"),
        (("frames", 1, "transform_matrix"), "x", "transform_matrix must be a 4x4"),
        (("frames", 1, "transform_matrix", 0, 0), float("nan"), "transform_matrix must be a 4x4 .* finite"),
        (("frames", 1, "transform_matrix", 0), [0, 0, 0, 0], "transform_matrix cannot be inverted"),
        (("frames", 1, "transform_matrix", 0), [2, 0, 0, 0], "is not a rotation"),
        (("frames", 1, "time"), "now", "time must be a finite number; got 'now'"),
        (("w",), None, "w must be a finite number; got nothing"),
        (("h",), 240.5, "h must be a whole number from 1 to 65536; got 240.5"),
        (("fl_x",), -210, "fl_x must be positive; got -210"),
        (("cx",), None, "missing cx"),
        (("cy",), "middle", "cy must be a finite number; got 'middle'"),
        (("k1",), "much", "k1 must be a finite number; got 'much'"),
        (("k4",), 0.1, "k4 = 0.1, which model OPENCV does not support"),
        (("camera_model",), "EQUIRECTANGULAR", "unsupported model EQUIRECTANGULAR"),
        (("camera_model",), 5, "unknown camera_model 5"),
        (("applied_transform",), [[0, 0, 0, 0]] * 3, "applied_transform cannot be inverted"),
        (("applied_transform",), [1], "applied_transform must be a 4x4"),
        (("applied_scale",), 0, "applied_scale must be positive; got 0"),
        (("fps",), -1, "fps must be positive; got -1"),
        (
            ("frames", 1, "file_path"),
            "images/cam2/000001.jpg",
            "world_to_camera of camera 'cam2' differs.*must not move",
        ),
    ],
)
def test_what_a_file_lacks_is_named(tmp_path, path, value, said):
    meta = transforms(lenses())
    change(meta, path, value)
    file = write(tmp_path / "transforms.json", meta)
    with pytest.raises(CaptureError, match=said) as caught:
        read(file)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1]", "{", '{"frames": 1e'])
def test_what_is_no_json_is_named(tmp_path, text):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(CaptureError, match=r"transforms.json"):
        read(tmp_path / "transforms.json")
