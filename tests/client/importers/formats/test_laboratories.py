"""Caliscope, anipose, Pose2Sim and Qualisys: cameras come back from their files, and what a file lacks is said."""

from __future__ import annotations

import numpy as np
import pytest
from lenses import camera, pose
from rigs import anipose, caliscope, fields, lenses, qualisys, transforms, write, write_pictures

from client.importers.open_source import open_source, read_calibration
from scas4d_core.captures import CaptureError


def assert_same(calibration, rig, names=("cam1", "cam2", "cam10"), atol=1e-9):
    assert calibration.names == names
    for lens, was in zip(calibration.cameras, (rig[name] for name in ("cam1", "cam2", "cam10")), strict=True):
        assert np.allclose(lens.world_to_camera, was.world_to_camera, atol=atol)
        assert np.allclose(lens.intrinsics, was.intrinsics, atol=atol)
        assert np.allclose(lens.distortion, was.distortion, atol=1e-12)
        assert (lens.model, lens.width, lens.height) == (was.model, was.width, was.height)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
def test_anipose(tmp_path, model):
    rig = lenses(model)
    (tmp_path / "calibration.toml").write_text(anipose(rig))
    assert_same(read_calibration(tmp_path), rig)


def test_anipose_by_opencv(tmp_path):
    """Points land where OpenCV puts them, half a pixel on: the centre of the first pixel is (0.5, 0.5) here."""
    cv2 = pytest.importorskip("cv2")
    rotation, translation = [0.3, -1.1, 0.2], [0.4, -0.2, 3.0]
    k, distortions = [[210, 0, 157.8], [0, 214, 121.4], [0, 0, 1]], [-0.2, 0.05, 2e-3, -3e-3, 0.01]
    table = [f"{name} = {value}" for name, value in (("matrix", k), ("distortions", distortions))]
    table += ["size = [320.0, 240.0]", f"rotation = {rotation}", f"translation = {translation}", "fisheye = false"]
    (tmp_path / "calibration.toml").write_text("\n".join(["[cam_0]", 'name = "A"', *table]))
    (lens,) = read_calibration(tmp_path).cameras
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    arrays = [np.array(value, dtype=np.float64) for value in (rotation, translation, k, distortions)]
    wanted = cv2.projectPoints(points, *arrays)[0][:, 0] + 0.5
    again = cv2.Rodrigues(lens.world_to_camera[:3, :3])[0]
    found = cv2.projectPoints(points, again, lens.world_to_camera[:3, 3], lens.intrinsics, lens.distortion)[0][:, 0]
    assert np.allclose(found, wanted, atol=1e-6)


@pytest.mark.parametrize("file", ["Calib_scene.toml", "calibration/Calib.toml", "walk_camera_calibration.toml"])
def test_pose2sim_names_cameras_by_the_folders_of_their_boards(tmp_path, file):
    rig = lenses()
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text(anipose(rig, name="int_{}_img"))
    (tmp_path / "Config.toml").write_text("[project]\nframe_rate = 60\n")
    assert_same(read_calibration(tmp_path), rig)


@pytest.mark.parametrize("matrices", [False, True])
@pytest.mark.parametrize(("key", "name"), [("cam_id", "cam"), ("port", "port")])
def test_caliscope(tmp_path, matrices, key, name):
    rig = lenses()
    numbered = {i: rig[f"cam{i}"] for i in (2, 10, 1)}
    unposed = '[cameras.5]\ncam_id = 5\nsize = [320, 240]\nignore = false\nrotation = "null"\n'
    (tmp_path / "camera_array.toml").write_text(caliscope(numbered, key=key, matrices=matrices, more=unposed))
    found = read_calibration(tmp_path)
    assert_same(found, rig, names=(f"{name}_1", f"{name}_2", f"{name}_10"))
    assert found.remarks == ("camera_array.toml: skipped cameras that are ignored or have no pose: cam_5",)


@pytest.mark.parametrize(("unit", "left", "top"), [(64, 0, 0), (64, 24, 8), (128, 0, 0)])
def test_qualisys(tmp_path, unit, left, top):
    rig = lenses()
    (tmp_path / "Calib.qca.txt").write_text(qualisys(rig, unit=unit, left=left, top=top))
    assert_same(read_calibration(tmp_path), rig)


def test_qualisys_by_hand(tmp_path):
    """A camera 2 m above the floor's origin, looking straight down, x to the right: y of the world is up in its
    picture, and the point (0, 1 m, 0) is half a focal length above the middle."""
    text = (
        '<calibration><cameras><camera active="1" serial="12"><fov_video left="0" top="0" right="1919" bottom="1079"/>'
        '<transform x="0" y="0" z="2000" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/>'
        '<intrinsic sensorMinU="0" sensorMaxU="122879" sensorMinV="0" sensorMaxV="69119" focalLengthU="64000" '
        'focalLengthV="64000" centerPointU="61408" centerPointV="34528" skew="0" radialDistortion1="0" '
        'radialDistortion2="0" radialDistortion3="0" tangentalDistortion1="0" tangentalDistortion2="0"/></camera>'
        "</cameras></calibration>"
    )
    (tmp_path / "a.qca.txt").write_text(text)
    (lens,) = read_calibration(tmp_path).cameras
    uv, depth = lens.pinhole().project([0.0, 1.0, 0.0])
    assert depth == pytest.approx(2)
    assert uv == pytest.approx([960, 540 - 500])


def test_cameras_for_markers_are_left_out(tmp_path):
    rig = lenses()
    text = qualisys(rig).replace('serial="cam2" model="Miqus Video"', 'serial="cam2" model="Miqus M3"')
    (tmp_path / "Calib.qca.txt").write_text(text.replace('active="1" serial="cam10"', 'active="0" serial="cam10"'))
    found = read_calibration(tmp_path)
    assert found.names == ("cam1",)
    assert found.remarks == ("Calib.qca.txt: skipped cameras that record markers instead of video: cam2",)


def test_entities_are_refused(tmp_path):
    bomb = '<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c SYSTEM "file:///etc/hostname">]>\n'
    path = tmp_path / "Calib.qca.txt"
    for encoding in ("utf-8", "utf-16"):
        path.write_bytes(qualisys(lenses(), doctype=bomb).replace("'ASCII'", f"'{encoding}'").encode(encoding))
        with pytest.raises(CaptureError, match="declares a document type"):
            read_calibration(tmp_path)


def test_pictures_lie_in_folders_called_like_the_cameras(tmp_path):
    rig = lenses("PINHOLE")
    (tmp_path / "calibration.toml").write_text(anipose(rig))
    with pytest.raises(CaptureError, match=r"contains no images or videos of the cameras cam1, cam2, cam10"):
        open_source(tmp_path)
    with pytest.raises(CaptureError, match="lists no images"):
        open_source(tmp_path, pictures="named")
    write_pictures(tmp_path / "images")
    source = open_source(tmp_path)
    assert (source.rig.names, source.frame_count) == (("cam1", "cam2", "cam10"), 2)


def test_of_two_calibrations_one_has_to_be_named(tmp_path):
    rig = lenses()
    (tmp_path / "calibration.toml").write_text(anipose(rig))
    (tmp_path / "calibration").mkdir()
    other = tmp_path / "calibration" / "Calib.qca.txt"
    other.write_text(qualisys(rig))
    with pytest.raises(CaptureError, match=r"contains 2 calibrations \(calibration.toml, calibration/Calib.qca.txt\)"):
        read_calibration(tmp_path)
    assert_same(read_calibration(tmp_path, other), rig)
    assert_same(read_calibration(tmp_path, tmp_path / "calibration"), rig)
    write(tmp_path / "transforms.json", transforms(rig))
    found = read_calibration(tmp_path)
    assert_same(found, rig)
    assert "transforms.json, not calibration.toml, calibration/Calib.qca.txt" in found.remarks[0]


def change(text, old, new):
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("size = [ 320, 240,]", "", r"\[cam_0\]: size must be 2 finite numbers; got nothing"),
        ("size = [ 320, 240,]", "size = [320.5, 240]", "width and height in whole pixels"),
        ("size = [ 320, 240,]", "size = [320, inf]", "size must be 2 finite numbers; got .*inf"),
        ("translation = [", "translation = [1.0, ", "translation must be 3 finite numbers"),
        ("rotation = [", "rotation = [1.0, ", "rotation must be 3 or 9 finite numbers"),
        ("distortions = [", "distortions = [1.0, ", "distortions must be 4 or 5 or 8 or 12 or 14 finite numbers"),
        ("matrix = [[", "matrix = [[0.0], [", "the camera matrix must be 9 finite numbers"),
        ("[0.0, 214.0, ", "[7.0, 214.0, ", r"is not \[\[fx, 0, cx\], .*; calibrate without skew"),
        ("matrix = [[210.0, 0.0,", "matrix = [[210.0, 1.0,", "calibrate without skew"),
        ('name = "cam2"', 'name = "cam1"', "two cameras are named 'cam1'"),
        ('name = "cam2"', "name = 1.5", r"\[cam_0\]: name must be a string; got 1.5"),
        ("[metadata]", "[metadata]\n[", "cannot be read as TOML"),
        ("[cam_0]", "zoom = 3\n[cam_0]", "zoom is not a camera table"),
    ],
)
def test_what_cannot_be_is_named(tmp_path, old, new, said):
    (tmp_path / "calibration.toml").write_text(change(anipose(lenses()), old, new))
    with pytest.raises(CaptureError, match=said):
        read_calibration(tmp_path)


def test_a_transposed_matrix_is_named(tmp_path):
    k = "[[210.0, 0.0, 0.0], [0.0, 214.0, 0.0], [158.0, 121.0, 1.0]]"
    text = anipose({"a": lenses()["cam1"]}).splitlines()
    text = [f"matrix = {k}" if line.startswith("matrix") else line for line in text]
    (tmp_path / "calibration.toml").write_text("\n".join(text))
    with pytest.raises(CaptureError, match="it is transposed"):
        read_calibration(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("<cameras>", "<cameras", "cannot be read as XML"),
        ("'ASCII'", "'klingon'", "cannot be read as XML"),
        ('r11="', 'r99="', r"camera 'cam2': r11 of transform must be a finite number; got None"),
        ('focalLengthU="', 'focalLengthU="x', "focalLengthU of intrinsic must be a finite number"),
        ('sensorMaxU="', 'sensorMaxU="1', r"subpixels per pixel instead of QTM's 64"),
        ("fov_video ", "fov_radio ", "left of fov_video must be a finite number; got None"),
    ],
)
def test_what_qualisys_cannot_have_written_is_named(tmp_path, old, new, said):
    (tmp_path / "Calib.qca.txt").write_text(change(qualisys(lenses()), old, new))
    with pytest.raises(CaptureError, match=said):
        read_calibration(tmp_path)


def test_files_of_other_kinds_are_refused(tmp_path):
    for name, text, said in (
        ("Calib.toml", "[project]\nname = 1\n", "contains no camera tables"),
        ("rig.txt", "", "is no calibration in a known format"),
        ("empty.qca.txt", "<calibration/>", "contains no cameras"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(CaptureError, match=said):
            read_calibration(tmp_path, tmp_path / name)


def test_left_handed_rotations_are_named(tmp_path):
    lens = lenses()["cam1"]
    mirrored = lens.world_to_camera[:3, :3] * [1, 1, -1]
    (tmp_path / "camera_array.toml").write_text("\n".join(["[cameras.1]", *fields(lens, rotation=mirrored)]))
    with pytest.raises(CaptureError, match=r"\[cameras.1\]: camera 'cam_1': .*determinant -1 \(left-handed\)"):
        read_calibration(tmp_path)


def test_poses_the_wrong_way_round_are_remarked(tmp_path):
    rig = {}
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, 6, endpoint=False)):
        to_camera = pose(angle)
        to_camera[:2, 3] = 0
        rig[f"c{i}"] = camera("PINHOLE", f"c{i}", to_camera)
    write_pictures(tmp_path / "images", names=rig)
    (tmp_path / "calibration.toml").write_text(anipose(rig))
    assert open_source(tmp_path).remarks == ()
    wrong = {name: camera("PINHOLE", name, np.linalg.inv(lens.world_to_camera)) for name, lens in rig.items()}
    (tmp_path / "calibration.toml").write_text(anipose(wrong))
    (remark,) = open_source(tmp_path).remarks
    assert "the poses seem to be inverted" in remark
