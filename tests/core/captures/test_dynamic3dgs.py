import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scas4d_core.captures import CaptureError, ImageError, open_capture
from scas4d_core.captures.images import decode_image

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"
FRAMES = 3


def meta(cameras):
    pose = np.eye(4)
    rows = [[(pose + np.outer([0, 0, 1, 0], [0, 0, 0, camera])).tolist() for camera in cameras]] * FRAMES
    return {
        "w": 8,
        "h": 6,
        "k": [[[[9.0, 0, 4], [0, 9.0, 3], [0, 0, 1]]] * len(cameras)] * FRAMES,
        "w2c": rows,
        "fn": [[f"{camera}/{frame:06d}.png" for camera in cameras] for frame in range(FRAMES)],
        "cam_id": [cameras] * FRAMES,
    }


def shade(camera, frame):
    return np.full((6, 8, 3), 10 * camera + frame, np.uint8)


@pytest.fixture
def folder(tmp_path):
    """Training cameras 0, 1, 3 and test camera 2; three frames; masks, cloud and ground truth."""
    for file, cameras in (("train_meta.json", [0, 1, 3]), ("test_meta.json", [2])):
        (tmp_path / file).write_text(json.dumps(meta(cameras)))
    for camera in range(4):
        for kind in ("ims", "seg", "gt_parts"):
            (tmp_path / kind / str(camera)).mkdir(parents=True)
        for frame in range(FRAMES):
            Image.fromarray(shade(camera, frame)).save(tmp_path / f"ims/{camera}/{frame:06d}.png")
            mask = np.zeros((6, 8), np.uint8)
            mask[:, : camera + 1] = 1
            Image.fromarray(mask).save(tmp_path / f"seg/{camera}/{frame:06d}.png")
            Image.fromarray(mask * (frame + 1)).save(tmp_path / f"gt_parts/{camera}/{frame:06d}.png")
    for camera in (0, 1, 3):  # labels of the test camera only
        for path in (tmp_path / f"gt_parts/{camera}").iterdir():
            path.unlink()
        (tmp_path / f"gt_parts/{camera}").rmdir()
    cloud = np.tile(np.array([[1.0, 2, 3, 0.1, 0.2, 0.3, 1.0]], np.float32), (5, 1))
    np.savez(tmp_path / "init_pt_cld.npz", data=cloud)
    points = np.zeros((FRAMES, 2, 3), np.float32)
    points[:, 1, 0] = [0, 1, 2]
    visible = np.zeros((FRAMES, 4, 2), bool)
    visible[:, 2, 1] = True
    np.savez(tmp_path / "gt_tracks.npz", points=points, part_id=[1, 2], visible=visible)
    flags = {"rigid": True, "foreground": True}
    parts = [
        {"id": 1, "name": "base", "static": True, "pose": [np.eye(4).tolist()] * FRAMES, **flags},
        {"id": 2, "name": "cloth", "static": False, **(flags | {"rigid": False})},
    ]
    (tmp_path / "scene.json").write_text(json.dumps({"extent": 2.5, "parts": parts}))
    return tmp_path


def change(path, **entries):
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def test_a_capture_is_read(folder):
    capture = open_capture(folder)
    assert capture.rig.names == ("0", "1", "3")
    assert capture.test_rig.names == ("2",)
    assert (capture.frame_count, capture.fps, capture.extent) == (3, 30.0, 2.5)
    assert capture.rig["3"].centre.tolist() == [0, 0, -3]
    frame = capture.frame(2)
    assert (frame.index, frame.time) == (2, pytest.approx(2 / 30))
    assert list(frame.images) == ["0", "1", "3"]
    np.testing.assert_array_equal(frame.images["3"], shade(3, 2))
    assert frame.masks["1"].sum() == 12
    test_frame = capture.test_frame(1)
    assert list(test_frame.images) == list(test_frame.masks) == ["2"]
    np.testing.assert_array_equal(test_frame.images["2"], shade(2, 1))


def test_points_are_float64_with_colours_and_labels(folder):
    points = open_capture(folder).points
    assert len(points) == 5
    assert (points.positions.dtype, points.colours.dtype, points.foreground.dtype) == ("float64", "float32", "float32")
    np.testing.assert_allclose(points.positions[0], [1, 2, 3])
    np.testing.assert_allclose(points.colours[4], [0.1, 0.2, 0.3])
    assert open_capture(folder, use_points=False).points is None


def test_the_ground_truth_is_known_by_camera_name(folder):
    truth = open_capture(folder).ground_truth
    assert truth.visible_in("2").tolist() == [[False, True]] * 3
    assert not truth.visible_in("3").any()
    with pytest.raises(KeyError):
        truth.visible_in("9")
    assert truth.moving.tolist() == [False, True]
    assert [(part.id, part.name, part.rigid, part.static) for part in truth.parts] == [
        (1, "base", True, True),
        (2, "cloth", False, False),
    ]
    assert truth.parts[0].pose.shape == (3, 4, 4)
    assert truth.parts[1].pose is None
    assert truth.label_cameras == ("2",)
    assert truth.labels("2", 1)[0].tolist() == [2, 2, 2, 0, 0, 0, 0, 0]


def test_everything_is_scaled_together(folder):
    capture = open_capture(folder, image_scale=0.5)
    assert (capture.rig["0"].width, capture.rig["0"].height, capture.rig["0"].cx) == (4, 3, 2.0)
    assert capture.full_rig["0"].width == 8
    assert capture.frame(0).images["0"].shape == (3, 4, 3)
    assert capture.frame(0).masks["1"].tolist() == [[1, 0, 0, 0]] * 3
    assert capture.test_frame(0).images["2"].shape == (3, 4, 3)
    assert capture.ground_truth.labels("2", 0).shape == (3, 4)


def test_files_can_be_pushed_without_decoding(folder):
    capture = open_capture(folder, image_scale=0.5)
    assert capture.encoded_image(1, "3") == (folder / "ims/3/000001.png").read_bytes()
    assert capture.encoded_image(1, "2") == (folder / "ims/2/000001.png").read_bytes()
    assert capture.encoded_mask(1, "3") == (folder / "seg/3/000001.png").read_bytes()
    assert open_capture(folder, use_masks=False).encoded_mask(1, "3") is None
    with pytest.raises(KeyError):
        capture.encoded_image(0, "7")
    for index in (-1, 3):
        with pytest.raises(IndexError, match=r"out of range 0…2"):
            capture.encoded_image(index, "3")
        with pytest.raises(IndexError, match=r"out of range 0…2"):
            capture.frame(index)


def test_pictures_are_decoded_when_looked_at(folder):
    capture = open_capture(folder)
    (folder / "ims/1/000001.png").write_bytes(b"damaged")
    frame = capture.frame(1)
    assert frame.images["0"].shape == (6, 8, 3)
    assert "1" in frame.images
    assert "7" not in frame.images
    with pytest.raises(ImageError, match=r"000001\.png: not a JPEG"):
        frame.images["1"]


def test_the_bit_depth_of_16_bit_pictures_is_found(folder):
    for path in (folder / "ims").rglob("*.png"):
        Image.fromarray(np.full((6, 8), 3000, np.uint16)).save(path)
    capture = open_capture(folder)
    assert "from a bit depth of 12" in capture.remarks[0]
    assert capture.frame(1).images["0"].max() == decode_image(capture.encoded_image(1, "0")).max() == 187
    assert open_capture(folder, bit_depth=16).frame(1).images["0"].max() == 12


def test_everything_but_pictures_and_cameras_is_optional(folder):
    for path in ("test_meta.json", "init_pt_cld.npz", "gt_tracks.npz", "scene.json"):
        (folder / path).unlink()
    (folder / "seg").rename(folder / "unused")
    capture = open_capture(folder)
    assert capture.test_rig is None
    assert capture.points is None
    assert capture.ground_truth is None
    assert capture.extent is None
    assert len(capture.frame(0).masks) == 0
    with pytest.raises(CaptureError, match="no test cameras"):
        capture.test_frame(0)


def test_test_cameras_may_lack_masks(folder):
    for frame in range(FRAMES):
        (folder / f"seg/2/{frame:06d}.png").unlink()
    capture = open_capture(folder)
    assert len(capture.test_frame(0).masks) == 0
    assert len(capture.frame(0).masks) == 3


def test_no_folder_and_no_layout(tmp_path):
    with pytest.raises(CaptureError, match="no such folder"):
        open_capture(tmp_path / "nowhere")
    with pytest.raises(CaptureError, match=r"unknown capture layout.*train_meta\.json"):
        open_capture(tmp_path)


MOVED = meta([0, 1, 3])["w2c"][0]
ELSEWHERE = json.loads(json.dumps(MOVED))
ELSEWHERE[1][0][3] = 0.01


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"w": 8.5}, r"w must be a positive whole number of pixels; got 8\.5"),
        ({"h": 0}, "h must be .* got 0"),
        ({"w": 16}, r"0[/\\]000000\.png is 8x6 pixels, but camera '0' was calibrated for 16x6"),
        ({"k": [[[1, 2], [3, 4]]]}, r"k must have shape \[3, 3, 3, 3\]"),
        ({"k": [[1, 2], [3]]}, "k must be numeric"),
        ({"k": [[[["a"] * 3] * 3] * 3] * 3}, "k must be numeric"),
        ({"k": [[[[9.0, 0, float("nan")], [0, 9.0, 3], [0, 0, 1]]] * 3] * 3}, "camera '0': intrinsics contains NaN"),
        (
            {"w2c": [MOVED, MOVED, ELSEWHERE]},
            "w2c of camera number 1 changes at frame 2, but cameras must not move",
        ),
        ({"cam_id": [[0, 1, 3], [0, 1, 3], [1, 0, 3]]}, "cam_id of frame 2 differs"),
        ({"cam_id": []}, "cam_id must be a non-empty list"),
        ({"cam_id": [[0, 0, 3]] * 3}, "duplicates: 0"),
        ({"cam_id": [[0, 1, 2]] * 3}, "cam_id 2 is also used in train_meta"),
        ({"fn": [["0/000000.png"] * 3] * 2}, "fn must list 3 frames"),
        ({"fn": [["0/000000.png"] * 2] * 3}, r"fn\[0\] must list 3 file names"),
        ({"fn": [["0/000000.png", "../../secret.png", "a.png"]] * 3}, r"secret\.png' points outside ims/"),
        ({"fn": [["0/000000.png", "/etc/passwd", "a.png"]] * 3}, "points outside ims/"),
        (
            {"fn": [["0/000000.png", "1/000009.png", "3/000009.png"]] * 3},
            r"000009\.png: no such file \(listed in train_meta",
        ),
    ],
)
def test_faults_of_the_cameras_are_named(folder, entries, message):
    change(folder / "train_meta.json", **entries)
    with pytest.raises(CaptureError, match=message):
        open_capture(folder)


def test_broken_json_is_named(folder):
    faults = ("{", " is not valid JSON"), ("[]", " must contain a JSON object"), ('{"w": 3}', ": missing h, k, w2c")
    for text, message in faults:
        (folder / "train_meta.json").write_text(text)
        with pytest.raises(CaptureError, match=rf"train_meta\.json{message}"):
            open_capture(folder)


def test_a_missing_mask_of_a_training_camera_is_named(folder):
    (folder / "seg/1/000002.png").unlink()
    with pytest.raises(CaptureError, match=r"seg.1.000002\.png: no mask for camera 1; .*use_masks=False"):
        open_capture(folder)
    assert len(open_capture(folder, use_masks=False).frame(0).masks) == 0


def test_test_cameras_must_have_the_same_frames(folder):
    short = {key: value[:2] if isinstance(value, list) else value for key, value in meta([2]).items()}
    change(folder / "test_meta.json", **short)
    with pytest.raises(CaptureError, match=r"test_meta\.json has 2 frames, but train_meta\.json has 3"):
        open_capture(folder)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.zeros((4, 5)), r"data must be a numeric array of shape \[P, 7\]"),
        (np.zeros((0, 7)), r"data must be a numeric array of shape \[P, 7\]"),
        (np.full((4, 7), 200.0), "by 255"),
        (np.array([[0.0] * 7, [np.nan] + [0.0] * 6]), "NaN or infinity in row 1"),
        (np.array([[{}] * 7]), "without pickle"),
    ],
)
def test_faults_of_the_cloud_are_named(folder, data, message):
    np.savez(folder / "init_pt_cld.npz", data=data)
    with pytest.raises(CaptureError, match=rf"init_pt_cld\.npz.*{message}"):
        open_capture(folder)


def test_a_cloud_that_is_no_npz_is_named(folder):
    (folder / "init_pt_cld.npz").write_bytes(b"PK\3\4 damaged")
    with pytest.raises(CaptureError, match=r"init_pt_cld\.npz cannot be read as an npz"):
        open_capture(folder)
    np.savez(folder / "init_pt_cld.npz", points=np.zeros((4, 7)))
    with pytest.raises(CaptureError, match=r"missing array .*required arrays: data"):
        open_capture(folder)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": np.zeros((2, 2, 3))}, r"points must be finite with shape \[T=3, P, 3\]"),
        ({"part_id": np.zeros(3)}, r"part_id must have shape \[P=2\]"),
        ({"visible": np.zeros((3, 4, 5), bool)}, "visible must have shape"),
    ],
)
def test_faults_of_the_tracks_are_named(folder, arrays, message):
    with np.load(folder / "gt_tracks.npz") as file:
        np.savez(folder / "gt_tracks.npz", **({key: file[key] for key in file.files} | arrays))
    with pytest.raises(CaptureError, match=rf"gt_tracks\.npz: {message}"):
        open_capture(folder)


def test_faults_of_parts_labels_and_extent_are_named(folder):
    scene = json.loads((folder / "scene.json").read_text())
    change(folder / "scene.json", parts=[scene["parts"][0] | {"pose": [[1, 2]]}])
    with pytest.raises(CaptureError, match=r"parts\[0\]\.pose must have shape \[T=3, 4, 4\]"):
        open_capture(folder)
    change(folder / "scene.json", parts=[{"id": 3}])
    with pytest.raises(CaptureError, match=r"parts\[0\] is not a valid part"):
        open_capture(folder)
    change(folder / "scene.json", parts=[], extent=-1)
    with pytest.raises(CaptureError, match="extent must be a positive number; got -1"):
        open_capture(folder)
    change(folder / "scene.json", extent=1)
    (folder / "gt_parts/2/000001.png").unlink()
    with pytest.raises(CaptureError, match=r"000001\.png: no such file; label all frames of camera 2, or none"):
        open_capture(folder)


def test_options_are_checked(folder):
    with pytest.raises(CaptureError, match=r"fps must be .* got 0"):
        open_capture(folder, fps=0)
    with pytest.raises(ImageError, match="image_scale"):
        open_capture(folder, image_scale=-1)


def test_reading_needs_numpy_and_pillow_only(folder):
    code = (
        "import sys; from scas4d_core.captures import open_capture; "
        f"c = open_capture({str(folder)!r}); c.frame(0).images['0']; c.ground_truth.labels('2', 0); "
        "heavy = {'torch', 'numba', 'scipy', 'sklearn', 'pydantic'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_sample_capture_is_whole_and_small():
    capture = open_capture(SAMPLE)
    assert (len(capture.rig), len(capture.test_rig), capture.frame_count) == (16, 2, 14)
    assert sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file()) <= 6e6
    truth = capture.ground_truth
    for name, rig, frame in (("4", capture.test_rig, capture.test_frame(13)), ("7", capture.rig, capture.frame(13))):
        uv, _ = rig[name].project(truth.points[13])
        seen = np.floor(uv[truth.visible_in(name)[13]]).astype(int)
        assert len(seen) > 100
        # Points on the silhouette may fall on the neighbouring pixel.
        assert frame.masks[name][seen[:, 1], seen[:, 0]].mean() > 0.95
    uv, _ = capture.test_rig["4"].project(truth.points[13])
    seen = truth.visible_in("4")[13]
    pixels = np.floor(uv[seen]).astype(int)
    agree = truth.labels("4", 13)[pixels[:, 1], pixels[:, 0]] == truth.part_id[seen]
    assert agree.mean() > 0.95


@pytest.mark.parametrize("name", ["../../away", "/etc", "a b", "", ".hidden"])
def test_a_camera_name_that_leads_elsewhere_is_refused(folder, name):
    change(folder / "test_meta.json", cam_id=[[name]] * FRAMES)
    with pytest.raises(CaptureError, match="cam_id"):
        open_capture(folder)


def test_a_bitmap_is_sent_as_png(folder):
    for path in (folder / "ims/0").iterdir():
        Image.open(path).save(path.with_suffix(".bmp"))
        path.unlink()
    train = json.loads((folder / "train_meta.json").read_text())
    train["fn"] = [
        [name.replace(".png", ".bmp") if name.startswith("0/") else name for name in row] for row in train["fn"]
    ]
    (folder / "train_meta.json").write_text(json.dumps(train))
    capture = open_capture(folder)
    sent = capture.encoded_image(1, "0")
    assert sent.startswith(b"\x89PNG")
    assert np.array_equal(decode_image(sent), shade(0, 1))
