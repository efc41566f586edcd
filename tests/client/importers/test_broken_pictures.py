"""A broken image or video: its camera is left out of the frame with the reason, and everything else stays as it is."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from films import FRAMES, RATE, encode, number
from lenses import HEIGHT, WIDTH
from PIL import Image
from rigs import NAMES, anipose, lenses, transforms, write

from client.importers.open_source import open_source
from client.importers.write import write_dynamic3dgs
from scas4d_core.captures import CaptureError

COUNT = 3


def draw(camera, frame):
    noise = np.random.default_rng(10 * frame + NAMES.index(camera)).integers(0, 256, (HEIGHT, WIDTH, 3))
    return Image.fromarray(noise.astype(np.uint8))


def camera_folders(folder):
    write(folder / "transforms.json", transforms(lenses("PINHOLE"), "PINHOLE"))
    return "images/{camera}/{frame:06d}.png"


def frame_folders(folder):
    folder.mkdir(exist_ok=True)
    (folder / "calibration.toml").write_text(anipose(lenses("PINHOLE")))
    return "images/{frame:06d}/{camera}.png"


def named_images(folder):
    rig = lenses("PINHOLE")
    meta = transforms(rig, "PINHOLE")
    entries = [
        frame | {"file_path": f"photos/{camera}/{t}.png", "time": t / 10}
        for camera, frame in zip(rig, meta["frames"], strict=True)
        for t in range(COUNT)
    ]
    write(folder / "transforms.json", meta | {"frames": entries})
    return "photos/{camera}/{frame}.png"


def dynamic3dgs(folder):
    rig = lenses("PINHOLE")
    meta = {"w": WIDTH, "h": HEIGHT, "cam_id": [list(NAMES)] * COUNT}
    meta["k"] = [[rig[name].intrinsics.tolist() for name in NAMES]] * COUNT
    meta["w2c"] = [[rig[name].world_to_camera.tolist() for name in NAMES]] * COUNT
    meta["fn"] = [[f"{name}/{t:06d}.png" for name in NAMES] for t in range(COUNT)]
    folder.mkdir(exist_ok=True)
    (folder / "train_meta.json").write_text(json.dumps(meta))
    return "ims/{camera}/{frame:06d}.png"


LAYOUTS = (camera_folders, frame_folders, named_images, dynamic3dgs)


def make(layout, folder):
    """Writes a capture of the layout, and returns the path of an image as a function of camera and frame."""
    pattern = layout(folder)

    def path(camera, frame):
        return folder / pattern.format(camera=camera, frame=frame)

    for camera in NAMES:
        for frame in range(COUNT):
            path(camera, frame).parent.mkdir(parents=True, exist_ok=True)
            draw(camera, frame).save(path(camera, frame))
    return path


def as_folder(path):
    path.unlink()
    path.mkdir()


FAULTS = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-2000]),
    "empty": lambda path: path.write_bytes(b""),
    "other content": lambda path: path.write_bytes(b"<html>not found</html>"),
    "missing": lambda path: path.unlink(),
    "a folder": as_folder,
    "another size": lambda path: Image.new("RGB", (WIDTH, HEIGHT - 6)).save(path),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("frame", [0, 1, COUNT - 1])
def test_only_the_camera_of_the_broken_image_is_left_out(tmp_path, layout, fault, frame):
    path = make(layout, tmp_path)
    FAULTS[fault](path("cam10", frame))
    capture = open_source(tmp_path)
    assert (set(capture.rig.names), capture.frame_count) == (set(NAMES), COUNT)
    for index in range(COUNT):
        shown, left_out = capture.usable_frame(index)
        assert list(left_out) == (["cam10"] if index == frame else [])
        assert list(shown.images) == [name for name in capture.rig.names if name not in left_out]
        for name, image in shown.images.items():
            assert np.array_equal(image, np.asarray(draw(name, index)))
        for reason in left_out.values():
            assert (
                path("cam10", frame).name in reason
                or ("no image that belongs to" in reason and ".png" in reason)
                or ("is its last image" in reason)
            )
        for name in left_out:
            with pytest.raises(ValueError, match=r"\.png"):
                capture.encoded_image(index, name)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_camera_without_any_usable_image_is_left_out_of_all_frames(tmp_path, layout):
    path = make(layout, tmp_path)
    for frame in range(COUNT):
        path("cam10", frame).write_bytes(b"")
    capture = open_source(tmp_path)
    assert all(list(capture.usable_frame(index)[1]) == ["cam10"] for index in range(COUNT))
    for frame in range(COUNT):
        path("cam1", frame).write_bytes(b"")
    with pytest.raises(CaptureError, match=r"cam1.*cannot be read as an image|cam1\.png cannot be read as an image"):
        open_source(tmp_path)


def test_a_folder_that_must_not_be_listed_is_not_part_of_the_capture(tmp_path, monkeypatch):
    """As `lost+found` at the root of a disk."""
    make(frame_folders, tmp_path)
    for folder in (tmp_path / "images").iterdir():
        folder.rename(tmp_path / folder.name)
    (tmp_path / "images").rmdir()
    (tmp_path / "lost+found").mkdir()
    own = Path.iterdir

    def iterdir(path):
        if path.name == "lost+found":
            raise PermissionError(13, "Permission denied", str(path))
        return own(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    capture = open_source(tmp_path)
    assert (set(capture.rig.names), capture.frame_count) == (set(NAMES), COUNT)


def test_a_folder_that_must_not_be_searched_is_no_model(tmp_path, monkeypatch):
    (tmp_path / "sparse" / "lost+found").mkdir(parents=True)
    make(camera_folders, tmp_path)
    own = os.stat

    def stat(path, *arguments, **options):
        if "lost+found/" in str(path):
            raise PermissionError(13, "Permission denied", str(path))
        return own(path, *arguments, **options)

    monkeypatch.setattr(os, "stat", stat)
    assert open_source(tmp_path).frame_count == COUNT


def test_a_full_disk_is_named_with_the_file(tmp_path, monkeypatch):
    make(camera_folders, tmp_path / "raw")

    def full(path, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match=r"No space left on device: .*000000\.png"):
        write_dynamic3dgs(open_source(tmp_path / "raw"), tmp_path / "out")


@pytest.mark.parametrize("fps", [None, 24.0])
def test_a_frame_rate_that_is_null_is_not_given(tmp_path, fps):
    make(camera_folders, tmp_path)
    write(tmp_path / "transforms.json", transforms(lenses("PINHOLE"), "PINHOLE") | {"fps": fps})
    assert open_source(tmp_path).fps == (fps or 30.0)


def test_a_broken_mask_leaves_its_camera_out(tmp_path):
    make(camera_folders, tmp_path)
    for camera in NAMES:
        (tmp_path / "masks" / camera).mkdir(parents=True)
        for frame in range(COUNT):
            Image.new("L", (WIDTH, HEIGHT), 255).save(tmp_path / f"masks/{camera}/{frame:06d}.png")
    (tmp_path / "masks/cam1/000001.png").write_bytes(b"")
    shown, left_out = open_source(tmp_path).usable_frame(1)
    assert "masks/cam1/000001.png: " in left_out["cam1"]
    assert set(shown.images) == set(shown.masks) == {"cam2", "cam10"}
    (tmp_path / "masks/cam1/000001.png").unlink()
    with pytest.raises(CaptureError, match=r"cam1/000001.png, but its mask is None"):
        open_source(tmp_path)
    (tmp_path / "images/cam1/000001.png").unlink()  # now the camera has nothing in this frame
    assert list(open_source(tmp_path).usable_frame(1)[1]) == ["cam1"]


def test_a_capture_ends_with_the_last_frame_of_half_of_the_cameras(tmp_path):
    path = make(camera_folders, tmp_path)
    path("cam10", 1).unlink()
    path("cam10", 2).unlink()
    path("cam1", 2).unlink()
    capture = open_source(tmp_path)
    assert capture.frame_count == 2
    assert "ignored the last 1 frames, of which fewer than 2 cameras have an image" in capture.remarks
    assert "cam10/000000.png is its last image" in capture.usable_frame(1)[1]["cam10"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_import_is_written_without_the_broken_image_and_read_back(tmp_path, layout):
    path = make(layout, tmp_path / "raw")
    path("cam10", 0).write_bytes(path("cam10", 0).read_bytes()[:-2000])
    said = []
    left_out = write_dynamic3dgs(open_source(tmp_path / "raw"), tmp_path / "out", on_message=said.append)
    assert (left_out.images, left_out.frames, len(said)) == (1, [], 1)
    assert said[0].startswith("frame 0, without camera cam10: ")
    again = open_source(tmp_path / "out")
    assert [list(again.usable_frame(index)[1]) for index in range(COUNT)] == [["cam10"], [], []]
    assert again.rig["cam10"].width == WIDTH


@pytest.fixture
def rig_of_videos(tmp_path):
    pytest.importorskip("av")
    (tmp_path / "videos").mkdir()
    rig = lenses("PINHOLE")
    meta = transforms(rig, "PINHOLE", path="{}.png") | {"w": 64, "h": 48, "cx": 32, "cy": 24}
    write(tmp_path / "transforms.json", meta)
    for name in NAMES:
        encode(tmp_path / f"videos/{name}.mp4", "libx264", g=8, bf=0)
    return tmp_path


def damage(path, frame):
    """Destroys the data of one frame of a video."""
    import av

    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packet = [packet for packet in container.demux(video=0) if packet.size][frame]
    data[packet.pos + 4 : packet.pos + packet.size] = bytes(packet.size - 4)
    path.write_bytes(data)


def cut_short(path):
    encode(path, "libx264", range(6), g=8, bf=0)


def truncate(path):
    encode(path.with_suffix(".ts"), "libx264", g=8, bf=0)
    path.unlink()
    data = path.with_suffix(".ts").read_bytes()
    path.with_suffix(".ts").write_bytes(data[: len(data) // 2])


def damage_frame_6(path):
    damage(path, 6)


@pytest.mark.parametrize("fault", [cut_short, truncate, damage_frame_6])
def test_a_video_that_ends_or_breaks_midway_is_left_out_from_there(rig_of_videos, fault):
    fault(rig_of_videos / "videos/cam10.mp4")
    capture = open_source(rig_of_videos)
    assert (capture.frame_count, capture.fps) == (FRAMES, pytest.approx(RATE))
    left_out = [capture.usable_frame(index)[1] for index in range(FRAMES)]
    assert list(left_out[0]) == []
    first = next(index for index, reasons in enumerate(left_out) if reasons)
    assert list(left_out[first]) == ["cam10"]
    assert "videos/cam10." in left_out[first]["cam10"]
    assert f"frame {first}" in left_out[first]["cam10"] or f"after {first} frames" in left_out[first]["cam10"]
    for index in range(FRAMES):
        shown = capture.usable_frame(index)[0].images
        assert {number(image) for image in shown.values()} == {index}
        assert {"cam1", "cam2"} <= set(shown)


@pytest.mark.parametrize("content", [b"", b"no video"])
def test_a_video_that_cannot_be_read_is_left_out(rig_of_videos, content):
    (rig_of_videos / "videos/cam10.mp4").write_bytes(content)
    capture = open_source(rig_of_videos)
    assert capture.frame_count == FRAMES
    shown, left_out = capture.usable_frame(0)
    assert set(shown.images) == {"cam1", "cam2"}
    assert "cam10.mp4 cannot be read as video" in left_out["cam10"]
    (rig_of_videos / "videos/cam2.mp4").write_bytes(content)
    with pytest.raises(CaptureError, match=r"cam2.mp4 cannot be read as video"):
        open_source(rig_of_videos)
