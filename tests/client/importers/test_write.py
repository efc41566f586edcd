"""`scas4d import`: what was undistorted is read back by the core's own reader, without any importer."""

from __future__ import annotations

import json

import numpy as np
import pytest
from lenses import HEIGHT, WIDTH, dot_at, painted, seen
from PIL import Image
from rigs import lenses, transforms, write

from client.importers.open_source import open_source
from client.importers.write import write_dynamic3dgs
from scas4d_core.captures import CaptureError, open_capture

pytest.importorskip("cv2")

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (4, 3)) * [1, 1, 0.3] + [0, 0, 0.2]


@pytest.fixture
def distorted(tmp_path):
    """Three distorted cameras, two frames, masks; the dots move by 0.05."""
    rig = lenses("OPENCV")
    folder = tmp_path / "studio"
    write(folder / "transforms.json", transforms(rig, fps=12))
    for name, lens in rig.items():
        for kind in ("images", "masks"):
            (folder / kind / name).mkdir(parents=True)
        for t in range(2):
            dots = painted(seen(lens, POINTS + np.array([0.05 * t, 0, 0])))
            Image.fromarray(dots).save(folder / "images" / name / f"{t}.png")
            Image.fromarray(255 * (dots[..., 0] > 60).astype(np.uint8)).save(folder / "masks" / name / f"{t}.png")
    return folder


def test_what_was_imported_is_a_capture(distorted, tmp_path):
    source = open_source(distorted, encoding="png", test=("cam2",))
    rig = open_source(distorted).rig
    told = []
    write_dynamic3dgs(source, tmp_path / "out", on_progress=lambda *now: told.append(now))
    capture = open_capture(tmp_path / "out")
    assert told == [("frames", 1, 2), ("frames", 2, 2)]
    assert (capture.full_rig.names, capture.full_test_rig.names) == (("cam1", "cam10"), ("cam2",))
    assert (capture.frame_count, capture.fps, capture.points) == (2, 12, None)
    for camera in capture.full_rig.cameras:
        assert np.array_equal(camera.intrinsics, rig[camera.name].intrinsics)
        for t in range(2):
            frame = capture.frame(t)
            for uv in camera.project(POINTS + np.array([0.05 * t, 0, 0]))[0]:
                assert np.linalg.norm(dot_at(frame.images[camera.name], uv) - uv) < 0.1
                assert frame.masks[camera.name][int(uv[1]), int(uv[0])] == 1
    again = open_source(tmp_path / "out")
    assert again.encoded_image(1, "cam1") == source.encoded_image(1, "cam1")
    assert again.time(1) == pytest.approx(1 / 12)


def test_a_cloud_of_unknown_foreground_comes_along(tmp_path):
    pytest.importorskip("pycolmap")
    from rigs import colmap_model as model
    from rigs import write_pictures

    model(lenses("PINHOLE"), tmp_path / "in/sparse/0", "PINHOLE", True)
    write_pictures(tmp_path / "in/images")
    source = open_source(tmp_path / "in")
    write_dynamic3dgs(source, tmp_path / "out", frames=1)
    capture = open_capture(tmp_path / "out")
    assert capture.frame_count == 1
    assert np.allclose(capture.points.positions, source.points.positions)
    assert np.allclose(capture.points.colours, source.points.colours)
    assert capture.points.foreground is None


def test_what_cannot_be_written_is_named(distorted, tmp_path):
    with pytest.raises(CaptureError, match=r"unknown test camera 'cam3'; choose from cam1, cam2, cam10"):
        open_source(distorted, test=("cam3",))
    with pytest.raises(CaptureError, match="all cameras are test cameras"):
        open_source(distorted, test=("cam1", "cam2", "cam10"))
    with pytest.raises(CaptureError, match="is not empty; choose a new folder"):
        write_dynamic3dgs(open_source(distorted), distorted)


def test_cameras_of_different_sizes_are_written_and_read(tmp_path):
    meta = transforms(lenses("PINHOLE"), "PINHOLE", path="{}.png", per_frame=True)
    meta["frames"][0] |= {"w": 100, "h": 80}
    write(tmp_path / "transforms.json", meta)
    for frame in meta["frames"]:
        Image.new("RGB", (frame["w"], frame["h"])).save(tmp_path / frame["file_path"])
    write_dynamic3dgs(open_source(tmp_path), tmp_path / "out")
    capture = open_capture(tmp_path / "out")
    sizes = [(camera.name, camera.width, camera.height) for camera in capture.rig.cameras]
    assert sizes == [("cam1", WIDTH, HEIGHT), ("cam2", 100, 80), ("cam10", WIDTH, HEIGHT)]
    assert capture.frame(0).images["cam2"].shape == (80, 100, 3)
    meta = json.loads((tmp_path / "out/train_meta.json").read_text())
    (tmp_path / "out/train_meta.json").write_text(json.dumps(meta | {"w": [100, 100]}))
    with pytest.raises(CaptureError, match=r"w has 2 values, but cam_id lists 3 cameras"):
        open_capture(tmp_path / "out")


def test_a_folder_that_was_not_finished_is_no_capture(distorted, tmp_path):
    def interrupt(stage, done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dynamic3dgs(open_source(distorted), tmp_path / "out", on_progress=interrupt)
    with pytest.raises(CaptureError, match="unknown capture layout"):
        open_capture(tmp_path / "out")


def test_pictures_of_one_camera_that_end_otherwise_are_read_back(distorted, tmp_path):
    straight = tmp_path / "straight"
    rig = lenses("PINHOLE")
    write(straight / "transforms.json", transforms(rig))
    for name in rig:
        (straight / "images" / name).mkdir(parents=True)
        for t, end in enumerate((".png", ".jpg")):
            Image.new("RGB", (WIDTH, HEIGHT), (40 * t, 0, 90)).save(straight / "images" / name / f"{t}{end}")
    write_dynamic3dgs(open_source(straight), tmp_path / "out")
    again = open_capture(tmp_path / "out")
    assert again.frame_count == 2
    assert np.abs(again.frame(1).images["cam1"].astype(int) - (40, 0, 90)).max() < 4


@pytest.mark.parametrize(("times", "fps"), [((0.0, 0.5, 1.0), 2.0), ((0.0, 0.5, 3.0), None)])
def test_times_become_the_rate_or_are_refused(tmp_path, times, fps):
    rig = lenses("PINHOLE")
    meta = transforms(rig)
    meta["frames"] = [
        {**one, "file_path": f"images/{name}/{t}.png", "time": time}
        for name, one in zip(rig, meta["frames"], strict=True)
        for t, time in enumerate(times)
    ]
    write(tmp_path / "studio" / "transforms.json", meta)
    for name in rig:
        (tmp_path / "studio/images" / name).mkdir(parents=True)
        for t in range(3):
            Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "studio/images" / name / f"{t}.png")
    source = open_source(tmp_path / "studio")
    if fps is None:
        with pytest.raises(CaptureError, match=r"frame 1 is .* off a constant rate"):
            write_dynamic3dgs(source, tmp_path / "out")
        assert not (tmp_path / "out").exists()
    else:
        write_dynamic3dgs(source, tmp_path / "out")
        assert open_capture(tmp_path / "out").fps == pytest.approx(fps)
