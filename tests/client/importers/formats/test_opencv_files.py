"""EasyMocap's files and a file of OpenCV a camera: cameras come back, sizes are found, and what is missing is said."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
from lenses import HEIGHT, WIDTH
from rigs import NAMES, easymocap, lenses, opencv_file, opencv_matrix, write_pictures

from client.importers.extras import MissingExtraError
from client.importers.formats.opencv_storage import read_storage
from client.importers.open_source import open_source, read_calibration
from scas4d_core.captures import CaptureError

pytest.importorskip("yaml")


def assert_same(calibration, rig, names=("cam1", "cam2", "cam10")):
    assert calibration.names == names
    for lens in calibration.cameras:
        was = rig[lens.name]
        assert np.allclose(lens.world_to_camera, was.world_to_camera, atol=1e-9)
        assert np.allclose(lens.intrinsics, was.intrinsics, atol=1e-9)
        assert np.allclose(lens.distortion, was.distortion, atol=1e-12)
        assert (lens.model, lens.width, lens.height) == (was.model, WIDTH, HEIGHT)


@pytest.mark.parametrize("rotations", [("R", "Rot"), ("R",), ("Rot",)])
@pytest.mark.parametrize("place", [".", "calibration"])
def test_easymocap(tmp_path, rotations, place):
    rig = lenses()
    easymocap(rig, tmp_path / place, sizes=True, rotations=rotations)
    assert_same(read_calibration(tmp_path), rig)
    assert_same(read_calibration(tmp_path, tmp_path / place), rig)
    assert_same(read_calibration(tmp_path, tmp_path / place / "intri.yml"), rig)


def test_sizes_are_those_of_the_pictures(tmp_path):
    rig = lenses("PINHOLE")
    easymocap(rig, tmp_path)
    with pytest.raises(CaptureError, match=r"camera 'cam2' has no image size"):
        read_calibration(tmp_path)
    write_pictures(tmp_path / "images")
    source = open_source(tmp_path)
    assert (source.frame_count, source.rig["cam1"].width, source.rig["cam1"].height) == (2, WIDTH, HEIGHT)
    (tmp_path / "images/cam2/000000.png").write_bytes(b"no picture")
    assert open_source(tmp_path).rig["cam2"].width == WIDTH  # from its other image
    (tmp_path / "images/cam2/000001.png").write_bytes(b"no picture")
    with pytest.raises(CaptureError, match=r"cam2/000000.png cannot be read as an image"):
        open_source(tmp_path)


def test_sizes_are_those_of_the_videos(tmp_path):
    av = pytest.importorskip("av")
    rig = lenses("PINHOLE")
    easymocap(rig, tmp_path)
    (tmp_path / "videos").mkdir()
    for name in NAMES:
        with av.open(str(tmp_path / "videos" / f"{name}.mp4"), "w") as video:
            stream = video.add_stream("mpeg4", rate=10)
            stream.width, stream.height = WIDTH, HEIGHT
            video.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8), "rgb24")))
            video.mux(stream.encode())
    assert_same(read_calibration(tmp_path), rig)
    (tmp_path / "videos" / "cam2.mp4").write_bytes(b"no video")
    with pytest.raises(CaptureError, match=r"cam2.mp4 cannot be read as video"):
        read_calibration(tmp_path)


def test_cameras_without_a_pose_are_left_out(tmp_path):
    rig = lenses()
    easymocap(rig, tmp_path, sizes=True, posed=("cam1", "cam2"))
    found = read_calibration(tmp_path)
    assert_same(found, rig, names=("cam1", "cam2"))
    assert found.remarks == ("intri.yml: skipped cameras that have no pose in extri.yml: cam10",)


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("intri.yml", "names:", "cameras:", "missing `names`"),
        ("intri.yml", "K_cam2:", "L_cam2:", "camera 'cam2': the camera matrix must be 9 finite numbers; got nothing"),
        ("extri.yml", "R_cam2:", "R_gone:", None),
        ("extri.yml", "data: [ ", "data: [ 1", "R_cam2 and Rot_cam2 are different rotations|finite numbers"),
        ("extri.yml", "---\n", "---\n{[\n", "cannot be read as YAML"),
        ("intri.yml", f"W_cam2: {WIDTH}", "W_cam2: 0", "width and height in whole pixels"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, file, old, new, said):
    rig = lenses()
    easymocap(rig, tmp_path, sizes=True)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    if said is None:  # the matrix is there still
        assert_same(read_calibration(tmp_path), rig)
        return
    with pytest.raises(CaptureError, match=said):
        read_calibration(tmp_path)


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"])
@pytest.mark.parametrize("size", [True, False])
def test_a_file_a_camera(tmp_path, model, size):
    rig = lenses(model)
    write_pictures(tmp_path / "images")
    (tmp_path / "calibration").mkdir()
    for name, lens in rig.items():
        (tmp_path / "calibration" / f"{name}.yml").write_text(opencv_file(lens, size=size))
    (tmp_path / "calibration" / "notes.yml").write_text("camera_matrix: of the boards\n")
    assert_same(read_calibration(tmp_path), rig)
    assert_same(read_calibration(tmp_path, tmp_path / "calibration" / "cam2.yml"), rig)


@pytest.mark.parametrize("end", [".xml", ".yml", ".json"])
def test_files_that_opencv_wrote(tmp_path, end):
    cv2 = pytest.importorskip("cv2")
    rig = lenses()
    for name, lens in rig.items():
        storage = cv2.FileStorage(str(tmp_path / f"{name}{end}"), cv2.FILE_STORAGE_WRITE)
        storage.write("image_width", WIDTH)
        storage.write("image_height", HEIGHT)
        storage.write("K", opencv_matrix(lens))
        storage.write("D", lens.distortion[:5])
        storage.write("R", cv2.Rodrigues(lens.world_to_camera[:3, :3])[0])
        storage.write("T", lens.world_to_camera[:3, 3])
        storage.release()
    assert_same(read_calibration(tmp_path), rig)


def test_pyyaml_is_asked_for_by_name(tmp_path, monkeypatch):
    easymocap(lenses(), tmp_path, sizes=True)
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(MissingExtraError, match=r"reading YAML files requires PyYAML .*\[importers\]"):
        read_calibration(tmp_path)


def test_cameras_without_a_pose_are_left_out_and_a_rig_without_poses_is_refused(tmp_path):
    (tmp_path / "cam1.yml").write_text(opencv_file(lenses()["cam1"], pose=False))
    with pytest.raises(CaptureError, match=r"cam1.yml has no pose, nor has any other file .* add R and T"):
        read_calibration(tmp_path)
    (tmp_path / "cam2.yml").write_text(opencv_file(lenses()["cam2"]))
    found = read_calibration(tmp_path)
    assert found.names == ("cam2",)
    assert found.remarks == ("skipped cameras whose file contains no pose (R and T): cam1",)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("a.yml", "%YAML:1.0\n---\nx: " + "[ " * 5000 + "1" + " ]" * 5000, "cannot be read as YAML"),
        ("a.yml", "x: &a [1, 2]\ny: [*a, *a]\n", "aliases .* are not supported"),
        ("a.yml", "just a sentence", "contains no named fields"),
        ("a.xml", "<!DOCTYPE a><opencv_storage/>", "declares a document type"),
        ("a.json", "[1]", "must contain a JSON object"),
    ],
)
def test_documents_of_another_kind_are_refused(tmp_path, file, text, said):
    (tmp_path / file).write_text(text)
    with pytest.raises(CaptureError, match=said):
        read_storage(tmp_path / file)


def test_toml_nested_without_end_is_refused(tmp_path):
    (tmp_path / "calibration.toml").write_text("x = " + "[" * 5000)
    with pytest.raises(CaptureError, match="TOML"):
        read_calibration(tmp_path)


def test_a_camera_of_easymocap_looks_for_its_pictures_in_the_folder_alone(tmp_path):
    rig = lenses()
    inner = tmp_path / "capture"
    easymocap(rig, inner, sizes=False)
    write_pictures(tmp_path)
    for file in (inner / "intri.yml", inner / "extri.yml"):
        file.write_text(re.sub(r'(["_])cam', r"\1../../cam", file.read_text()))
    with pytest.raises(CaptureError, match=r"camera '../../cam2' has no image size"):
        read_calibration(inner)
