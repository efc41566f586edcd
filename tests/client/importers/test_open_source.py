"""Captures opened: layouts found, frames synchronized by name, and what a folder lacks said by name."""

from __future__ import annotations

import io

import numpy as np
import pytest
from lenses import HEIGHT, WIDTH, dot_at, painted, seen
from PIL import Image
from rigs import NAMES, lenses, transforms, write, write_pictures

from client.importers.calibration import natural
from client.importers.open_source import open_source
from client.importers.pictures import frames_of_cameras
from scas4d_core.captures import CaptureError, ImageError, decode_image, decode_mask


@pytest.fixture
def straight(tmp_path):
    """Pinhole cameras, two frames."""
    write(tmp_path / "transforms.json", transforms(lenses("PINHOLE"), "PINHOLE", fps=25))
    write_pictures(tmp_path / "images")
    return tmp_path


def test_pictures_of_straight_lenses_go_as_they_are(straight):
    source = open_source(straight)
    assert source.rig.names == ("cam1", "cam2", "cam10")
    assert (source.frame_count, source.fps, source.time(1)) == (2, 25, 1 / 25)
    assert source.encoded_image(1, "cam10") == (straight / "images/cam10/000001.png").read_bytes()
    assert source.encoded_mask(0, "cam1") is None
    assert source.points is None
    assert open_source(straight, fps=50).time(1) == 1 / 50


def test_pictures_of_a_camera_without_a_calibration_are_named(straight):
    assert open_source(straight).remarks == ()
    (straight / "images" / "cam7").mkdir()
    assert open_source(straight).remarks == ("skipped cameras that are not in transforms.json: cam7",)
    assert open_source(straight).rig.names == ("cam1", "cam2", "cam10")


def test_values_of_16_bit_pictures_are_scaled_alike_in_all_frames(straight):
    """The first frame is dark: it alone has 8 bits. The second shows that the cameras have 12."""
    for camera in NAMES:
        for frame, largest in enumerate((200, 4000)):
            values = np.full((HEIGHT, WIDTH), largest, np.uint16)
            Image.fromarray(values).save(straight / f"images/{camera}/{frame:06d}.png")
    source = open_source(straight)
    assert source.remarks == (
        "3 cameras, such as 'cam1': 16-bit images are converted to 8 bits from a bit depth of 12, which was found from "
        "their values; if it is wrong, set --bit-depth",
    )
    for frame, shade in enumerate((12, 249)):
        assert source.frame(frame).images["cam2"].max() == shade
        assert decode_image(source.encoded_image(frame, "cam2")).max() == shade
    assert open_source(straight, bit_depth=14).frame(1).images["cam2"].max() == 62
    with pytest.raises(ImageError, match=r"000001.png: the value 4000 exceeds 10 bits.*--bit-depth"):
        open_source(straight, bit_depth=10).encoded_image(1, "cam2")


def test_raw_pictures_are_read(straight):
    for camera in NAMES:
        for path in sorted((straight / "images" / camera).iterdir()):
            Image.open(path).convert("RGB").save(path.with_suffix(".ppm"))
            path.unlink()
    source = open_source(straight)
    shown = decode_image(source.encoded_image(1, "cam2"))
    np.testing.assert_array_equal(shown, source.frame(1).images["cam2"])


def test_a_rotated_picture_is_named_when_the_capture_is_opened(straight):
    exif = Image.Exif()
    exif[0x0112] = 6
    path = straight / "images/cam2/000000.png"
    Image.open(path).save(path, exif=exif)
    with pytest.raises(CaptureError, match=r"cam2/000000.png: EXIF orientation is 6.*remove the tag"):
        open_source(straight)


def test_frames_are_in_natural_order_and_one_name_is_one_frame(straight):
    names = ("f1", "f2", "f10", "f9")
    for camera in NAMES:
        for path in (straight / "images" / camera).iterdir():
            path.unlink()
    write_pictures(straight / "images", frames=names)
    for i, camera in enumerate(NAMES):
        (straight / "images" / camera / "notes.txt").write_text("not a picture")
        (straight / "images" / camera / ".f3.png").write_text("hidden")
        if i == 0:
            path = straight / "images" / camera / "f9.png"
            Image.open(path).save(path.with_suffix(".webp"), lossless=True)
            path.unlink()
    source = open_source(straight)
    shades = [decode_image(source.encoded_image(t, "cam2"))[0, 0, 1] for t in range(source.frame_count)]
    assert shades == [0, 40, 120, 80]  # f1, f2, f9, f10
    assert sorted(["cam10", "cam2", "a1b10", "a1b9"], key=natural) == ["a1b9", "a1b10", "cam2", "cam10"]


def test_undistorted_pictures_and_masks_fit_their_cameras(tmp_path):
    pytest.importorskip("cv2")
    rig = lenses("OPENCV")
    write(tmp_path / "transforms.json", transforms(rig))
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (4, 3)) * [1, 1, 0.3] + [0, 0, 0.2]
    for name, lens in rig.items():
        for kind in ("images", "masks"):
            (tmp_path / kind / name).mkdir(parents=True)
        dots = painted(seen(lens, points))
        Image.fromarray(dots).save(tmp_path / "images" / name / "0.png")
        Image.fromarray(255 * (dots[..., 0] > 60).astype(np.uint8)).save(tmp_path / "masks" / name / "0.png")
    for encoding, magic in (("png", b"\x89PNG"), ("jpeg", b"\xff\xd8")):
        source = open_source(tmp_path, encoding=encoding)
        for camera in source.rig.cameras:
            file = source.encoded_image(0, camera.name)
            assert file.startswith(magic)
            picture = decode_image(file, size=(camera.width, camera.height))
            mask = decode_mask(source.encoded_mask(0, camera.name), size=(camera.width, camera.height))
            for uv in camera.project(points)[0]:
                assert np.linalg.norm(dot_at(picture, uv) - uv) < 0.1
                assert mask[int(uv[1]), int(uv[0])] == 1
            assert 0 < mask.mean() < 0.1


def test_the_files_that_the_calibration_names(tmp_path):
    meta = transforms(lenses("PINHOLE"), "PINHOLE", path="photos/{}.png")
    write(tmp_path / "transforms.json", meta)
    (tmp_path / "photos").mkdir()
    for name in NAMES:
        Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "photos" / f"{name}.png")
    assert open_source(tmp_path).frame_count == 1
    (tmp_path / "photos/cam10.png").unlink()
    assert "camera 'cam10' has no image" in open_source(tmp_path).usable_frame(0)[1]["cam10"]
    (tmp_path / "photos/cam2.png").unlink()
    with pytest.raises(CaptureError, match=r"photos/cam.*.png: no such file, although .*transforms.json lists it"):
        open_source(tmp_path)


def timed(tmp_path, times=(0.0, 0.04, 0.1)):
    meta = transforms(lenses("PINHOLE"), "PINHOLE")
    meta["frames"] = []
    for t, time in enumerate(times):
        more = transforms(lenses("PINHOLE"), "PINHOLE", path=f"images/{{}}/{t:06d}.png")["frames"]
        meta["frames"] += [one | {"time": time} for one in more]
    write_pictures(tmp_path / "images", frames=[f"{t:06d}" for t in range(len(times))])
    return meta


def test_a_listed_frame_without_any_file_has_no_usable_image(tmp_path):
    write(tmp_path / "transforms.json", timed(tmp_path))
    for camera in NAMES:
        (tmp_path / f"images/{camera}/000001.png").unlink()
    source = open_source(tmp_path)
    assert source.frame_count == 3
    assert source.usable_frame(1)[1] == {
        camera: f"camera {camera!r} has no image that belongs to frame '000001'" for camera in NAMES
    }
    assert source.usable_frame(2)[1] == {}


def test_of_cameras_without_common_frames_the_one_with_the_fewest_files_is_named(tmp_path):
    folders = {"a": ("0", "1", "2"), "b": ("0",), "c": ("1",), "d": ("2",)}
    for camera, frames in folders.items():
        (tmp_path / camera).mkdir()
        for frame in frames:
            (tmp_path / camera / f"{frame}.png").touch()
    with pytest.raises(CaptureError, match=r"b has no images for 2 of 3 frames \(1, 2\), but 'a' has them"):
        frames_of_cameras({camera: tmp_path / camera for camera in folders})


def test_times_of_the_calibration_are_taken(tmp_path):
    write(tmp_path / "transforms.json", timed(tmp_path))
    source = open_source(tmp_path)
    assert [source.time(t) for t in range(source.frame_count)] == [0.0, 0.04, 0.1]


def test_times_and_numbers_of_pictures_must_fit(tmp_path):
    meta = timed(tmp_path)
    meta["frames"][4]["time"] = 0.05
    write(tmp_path / "transforms.json", meta)
    with pytest.raises(CaptureError, match=r"frame 1 has images with different times .*0.05"):
        open_source(tmp_path)
    del meta["frames"][4]
    write(tmp_path / "transforms.json", meta)
    with pytest.raises(CaptureError, match=r"camera 'cam10' has 2 images, but 'cam2' has 3"):
        open_source(tmp_path)
    write(tmp_path / "transforms.json", timed(tmp_path, (0.0, 0.04, 0.04)))
    with pytest.raises(CaptureError, match=r"frame 2 is at 0.04 s, not later than the previous one"):
        open_source(tmp_path)


@pytest.mark.parametrize(
    ("start", "step", "unit"),
    [
        (0, 33.3, "milliseconds"),
        (1.7643636e18, 33_333_333, "Unix times in nanoseconds"),
        (1764363600, 0.03, "Unix times"),
    ],
)
def test_times_that_are_probably_not_seconds_are_named(tmp_path, start, step, unit):
    times = tuple(start + step * t for t in range(3))
    write(tmp_path / "transforms.json", timed(tmp_path, times))
    source = open_source(tmp_path)
    [remark] = [remark for remark in source.remarks if "probably" in remark]
    assert remark.startswith(f"the times are probably {unit}")
    assert f"frame 2 has the time {times[2]!r}" in remark
    assert source.time(2) == times[2]


def test_numbers_of_times_are_exact_and_bounded(tmp_path):
    write(tmp_path / "transforms.json", timed(tmp_path, (1764363600.25, 1764363600.5, 1764363600.5)))
    with pytest.raises(CaptureError, match=r"frame 2 is at 1764363600.5 s, not later .* 1764363600.5 s; correct"):
        open_source(tmp_path)
    write(tmp_path / "transforms.json", timed(tmp_path, (0.0, 0.04, 1e300)))
    with pytest.raises(CaptureError, match=r"frame 2 is at 1e\+300 s; give the times in seconds"):
        open_source(tmp_path)


def test_a_path_cannot_lead_out_of_the_capture(tmp_path):
    inner = tmp_path / "capture"
    inner.mkdir()
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "cam1.png")
    meta = transforms({"cam1": lenses("PINHOLE")["cam1"]}, "PINHOLE", path="../{}.png")
    write(inner / "transforms.json", meta)
    with pytest.raises(CaptureError, match="no such file"):
        open_source(inner)


def test_the_sample_goes_through_the_same_door(capture_folder):
    source = open_source(capture_folder)
    assert (source.rig.names, source.frame_count, source.fps) == (("0", "1"), 4, 30)
    assert source.encoded_image(0, "0").startswith(b"\x89PNG")
    assert source.encoded_mask(0, "0") is not None
    assert open_source(capture_folder, use_masks=False).encoded_mask(0, "0") is None
    assert len(source.points) == 5


@pytest.mark.parametrize("place", ["sparse/0", "sparse", ".", "colmap/sparse/0"])
def test_a_colmap_model_is_found(tmp_path, place):
    pytest.importorskip("pycolmap")
    from rigs import colmap_model as model

    model(lenses("PINHOLE"), tmp_path / place, "PINHOLE", True)
    write_pictures(tmp_path / "images")
    source = open_source(tmp_path)
    assert len(source.points) == 3
    elsewhere = tmp_path / "other"
    (tmp_path / place).rename(elsewhere) if place != "." else None
    if place != ".":
        assert open_source(tmp_path, calibration=elsewhere).rig.names == source.rig.names


def named_otherwise(folder):
    for path in (folder / "images/cam2").iterdir():
        path.rename(path.with_stem(f"2{path.stem}"))


def resize(folder):
    for path in (folder / "images/cam10").iterdir():
        Image.new("RGB", (WIDTH - 8, HEIGHT)).save(path)


def break_two_cameras(folder):
    for path in (*(folder / "images/cam1").iterdir(), *(folder / "images/cam2").iterdir()):
        path.write_bytes(b"x")


def video(folder):
    (folder / "videos").mkdir()
    (folder / "videos" / "cam1.mp4").write_bytes(b"")


def empty(folder):
    for path in (folder / "images/cam1").iterdir():
        path.unlink()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (named_otherwise, r"images/cam2 has no images for 2 of 4 frames \(000000, 000001\), but 'cam1' has"),
        (
            resize,
            r"cam10/000000.png is 312x240 pixels, but camera 'cam10' was calibrated for 320x240.*--size-mismatch",
        ),
        (empty, r"images/cam1 contains no images; supported file types: .jpg"),
        (
            lambda f: (f / "images/cam10").rename(f / "images/ten"),
            r"images contains no images of camera 'cam10' .* contains ten, .* name each folder after its camera",
        ),
        (lambda f: (f / "images/cam1/000000.tif").write_bytes(b""), r"000000.tif: .tif is not supported; use JPEG"),
        (lambda f: (f / "images/cam1/000000.jpg").write_bytes(b""), r"000000.png and 000000.jpg are the same frame"),
        (break_two_cameras, r"cam1/000000.png cannot be read as an image"),
        (lambda f: (f / "transforms.json").unlink(), r"unknown capture layout: .*: train_meta.json .*--calibration"),
        (video, r"contains images \(images/\) and videos \(videos/\); .*--pictures images"),
        (lambda f: (f / "masks").mkdir(), r"masks/cam1: no such folder"),
        (lambda f: write_pictures(f / "masks", frames=("000000",)), r"frame 1: its image is .*, but its mask is None"),
        (
            lambda f: write_pictures(f / "masks", frames=("000000", "7")),
            r"frame 1: .*masks/cam1/7.png; name each mask like its image",
        ),
    ],
)
def test_what_a_folder_lacks_is_named(straight, damage, said):
    damage(straight)
    with pytest.raises(CaptureError, match=said):
        open_source(straight)


def test_choices_that_cannot_be_are_named(straight):
    with pytest.raises(CaptureError, match="no such folder"):
        open_source(straight / "nowhere")
    with pytest.raises(CaptureError, match=r"contains no videos of the cameras cam1, cam2, cam10; images/ contains"):
        open_source(straight, pictures="videos")
    with pytest.raises(CaptureError, match=r"images contains no calibration in a known format"):
        open_source(straight, calibration=straight / "images")
    with pytest.raises(CaptureError, match="fps must be a positive number; got -1"):
        open_source(straight, fps=-1)


def test_bmp_files_are_encoded_for_the_way(straight):
    for camera in NAMES:
        for path in (straight / "images" / camera).iterdir():
            Image.open(path).save(path.with_suffix(".bmp"))
            path.unlink()
    with Image.open(io.BytesIO(open_source(straight, encoding="png").encoded_image(1, "cam1"))) as picture:
        assert (picture.format, picture.getpixel((0, 0))) == ("PNG", (80, 40, 99))
