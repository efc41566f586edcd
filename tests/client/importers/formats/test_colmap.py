"""COLMAP models written by COLMAP itself (pycolmap), text and binary, and damaged at every byte."""

from __future__ import annotations

import shutil
import struct

import numpy as np
import pytest
from lenses import HEIGHT, LENSES, WIDTH
from rigs import colmap_model as model
from rigs import lenses

from client.importers.formats.colmap import read_colmap
from client.importers.lens import MODELS
from scas4d_core.captures import CaptureError

pycolmap = pytest.importorskip("pycolmap")


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("name", LENSES)
def test_what_colmap_wrote_comes_back(tmp_path, name, binary):
    rig = lenses(name)
    calibration = read_colmap(model(rig, tmp_path, name, binary))
    assert calibration.names == ("cam1", "cam2", "cam10")
    for lens in calibration.cameras:
        was = rig[lens.name]
        assert np.allclose(lens.world_to_camera, was.world_to_camera, atol=1e-12)
        assert np.allclose(lens.intrinsics, was.intrinsics)
        assert np.allclose(lens.distortion, was.distortion)
        assert (lens.model, lens.width, lens.height) == (name, WIDTH, HEIGHT)
    order = np.argsort(calibration.points.positions[:, 0])
    assert calibration.points.positions[order].tolist() == [[0, 0.5, -1], [1, 0.5, -1], [2, 0.5, -1]]
    assert np.allclose(calibration.points.colours[order], [[1, 0, 0], [1, 0.2, 0], [1, 0.4, 0]])


def test_projections_agree_with_colmap(tmp_path):
    """COLMAP projects points with its own models: the lens here must see them at the same pixels."""
    from lenses import seen

    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    for name in LENSES:
        lens = next(iter(lenses(name).values()))
        values = [LENSES[name].get(key, 0.0) for key in MODELS[name]]
        camera = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=values)
        inside = points @ lens.world_to_camera[:3, :3].T + lens.world_to_camera[:3, 3]
        theirs = np.array([camera.img_from_cam(point) for point in inside])
        assert np.allclose(seen(lens, points), theirs.reshape(-1, 2), atol=1e-6)


def test_a_model_without_points_and_with_folders(tmp_path):
    calibration = read_colmap(model(lenses(), tmp_path, "OPENCV", True, points=0, path="{}/000001.png"))
    assert calibration.points is None
    assert calibration.names == ("cam1", "cam2", "cam10")
    (tmp_path / "points3D.bin").unlink()
    assert read_colmap(tmp_path).points is None


@pytest.mark.parametrize("name", ["FOV", "THIN_PRISM_FISHEYE", "RADIAL_FISHEYE"])
@pytest.mark.parametrize("binary", [False, True])
def test_other_models_are_refused_by_name(tmp_path, name, binary):
    count = len(pycolmap.Camera.create_from_model_name(1, name, 1.0, 1, 1).params)
    model(lenses("PINHOLE"), tmp_path, name, binary, parameters=[200.0] * count)
    with pytest.raises(CaptureError, match=rf"unsupported model {name}; calibrate with one of SIMPLE_PINHOLE"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_binary_file_cut_anywhere_says_so(tmp_path, file):
    whole = (model(lenses(), tmp_path, "OPENCV", True) / file).read_bytes()
    for length in range(len(whole)):
        (tmp_path / file).write_bytes(whole[:length])
        with pytest.raises(
            CaptureError, match=rf"{file}(: | is )(truncated after {length} bytes|the name of .* is not terminated)"
        ):
            read_colmap(tmp_path)


def test_a_count_that_cannot_be_ends_at_once(tmp_path):
    model(lenses(), tmp_path, "OPENCV", True)
    (tmp_path / "points3D.bin").write_bytes(struct.pack("<Q", 2**63))
    with pytest.raises(CaptureError, match=r"truncated after 8 bytes"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("cameras.txt", " OPENCV ", " OPENCV x", "cameras.txt: line .* expected: id MODEL width height"),
        ("cameras.txt", "320 240", "", "cameras.txt: camera 1 has 6 parameters"),
        ("images.txt", "cam2.jpg", "", "images.txt: line .* expected: id qw"),
        ("images.txt", "\n1 ", "\none ", "images.txt: line .*one.*expected: id qw"),
        ("points3D.txt", " 0.5 ", " half ", "points3D.txt: line .*half"),
    ],
)
def test_what_a_text_file_lacks_is_named(tmp_path, file, old, new, said):
    model(lenses(), tmp_path, "OPENCV", False)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new))
    with pytest.raises(CaptureError, match=said):
        read_colmap(tmp_path)


def test_parts_that_do_not_fit_each_other_are_named(tmp_path):
    folder = model(lenses(), tmp_path / "a", "OPENCV", False)
    cameras = (folder / "cameras.txt").read_text().splitlines()
    (folder / "cameras.txt").write_text("\n".join(cameras[:-1]))
    with pytest.raises(CaptureError, match=r"image .* refers to camera 3, which is not in cameras.txt"):
        read_colmap(folder)
    (folder / "cameras.txt").write_text("\n".join([*cameras[:-1], cameras[-1].rpartition(" ")[0]]))
    with pytest.raises(CaptureError, match=r"camera 3 has 7 parameters, but OPENCV requires 8: fx, fy"):
        read_colmap(folder)
    shutil.rmtree(folder)
    model(lenses(), folder, "OPENCV", False)
    (folder / "images.txt").write_text("# nothing\n")
    with pytest.raises(CaptureError, match=r"images.txt lists no images; if COLMAP registered none"):
        read_colmap(folder)
    (folder / "images.txt").write_text("1 2 0 0 0 0 0 0 1 cam1.jpg\n\n")
    with pytest.raises(CaptureError, match=r"cam1.jpg has an invalid pose .*unit quaternion"):
        read_colmap(folder)
    (folder / "images.txt").unlink()
    with pytest.raises(CaptureError, match=r"images.txt: no such file"):
        read_colmap(folder)


def test_a_camera_of_several_pictures_must_stand_still(tmp_path):
    rig = lenses()
    moved = {f"cam1/{name}": lens for name, lens in rig.items()} | {"cam2/a": rig["cam2"]}
    model(moved, tmp_path, "OPENCV", True)
    with pytest.raises(CaptureError, match=r"world_to_camera of camera 'cam1' differs.*one image per camera"):
        read_colmap(tmp_path)
