"""Videos are read back: size, rate, pictures, colours, and what is drawn over and beside them."""

from __future__ import annotations

import colorsys
import json
from itertools import pairwise

import numpy as np
import pytest
from export_cases.blob import BACKGROUND, BLOB, FRAMES, RATE, WORLD, centre, make_rig, state, true_colour
from PIL import Image
from running import make_rig as a_rig
from running import pictures
from typer.testing import CliRunner
from waiting import HANG_S

from client.cli.main import app
from client.exports.video.shot import VideoOptions
from client.exports.video.video import make_video, picture_size
from client.exports.video.video_file import video_file
from client.sdk import Client
from client.wire import part_colour
from scas4d_core.compact import CompactReader, CompactWriter, FileHeader
from scas4d_core.errors import InputError

av = pytest.importorskip("av")
FRONT = VideoOptions(path="camera")


def read(path):
    """[T, H, W, 3] of a video, and its stream."""
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        pictures = np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(stream)])
        about = stream.codec_context
        return pictures, stream.average_rate, (about.pix_fmt, int(about.color_range), int(about.colorspace))


def made(source, out, options=FRONT, **more):
    return make_video(str(source), out, options, url="http://127.0.0.1:9", token=None, **more)


def pixel_of(frame, camera=None):
    """Column and row of the blob's centre."""
    camera = camera or make_rig()["front"]
    u, v = camera.project(WORLD.to_user(centre(frame)))[0]
    return int(u), int(v)


@pytest.mark.parametrize("size", [(64, 48), (1280, 720)])
@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_colours_come_back_and_the_file_says_what_they_mean(tmp_path, suffix, size):
    """Small and large pictures: players guess the matrix of untagged videos by their height."""
    colours = [(230, 40, 90), (10, 200, 30), (30, 60, 250), (128, 128, 128)]
    path = tmp_path / "new" / f"a{suffix}"
    with video_file(path, 30000 / 1001) as add:
        for colour in colours:
            add(np.full((size[1], size[0], 3), colour, np.uint8))
    if suffix == ".mp4":
        shown, rate, about = read(path)
        assert (float(rate), about) == (pytest.approx(29.97, abs=0.001), ("yuv420p", 1, 1))
    else:
        with Image.open(path) as file:
            assert file.info["loop"] == 0
            shown, lasts = [], []
            for number in range(file.n_frames):
                file.seek(number)
                shown.append(np.asarray(file.convert("RGB")))
                lasts.append(file.info["duration"])
        assert sum(lasts) == pytest.approx(1000 * 4 / 29.97, abs=2)
    assert np.shape(shown) == (4, size[1], size[0], 3)
    for picture, colour in zip(shown, colours, strict=True):
        assert np.abs(picture.astype(int) - colour).max() <= 4


def test_an_mp4_is_even_and_a_webp_may_be_odd(tmp_path):
    for suffix, width in ((".mp4", 32), (".webp", 33)):
        with video_file(tmp_path / f"a{suffix}", 10) as add:
            add(np.zeros((24, 33, 3), np.uint8))
        if suffix == ".mp4":
            assert read(tmp_path / "a.mp4")[0].shape == (1, 24, width, 3)
        else:
            with Image.open(tmp_path / "a.webp") as file:
                assert file.size == (width, 24)


def test_a_video_that_breaks_off_leaves_the_one_before(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")
    with pytest.raises(ValueError, match="ndim"), video_file(path, 10) as add:
        add(np.zeros((16, 16), np.uint8))
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [b"before"]


def test_a_camera_sees_the_blob_where_it_is(source, tmp_path):
    shown, rate, _ = read(made(source, tmp_path / "a.mp4"))
    assert (shown.shape, rate) == ((FRAMES, 60, 80, 3), RATE)
    for frame in range(FRAMES):
        column, row = pixel_of(frame)
        assert shown[frame, row, column] @ [1, -1, -1] > 90  # red
        wall = shown[frame, 12, 40].astype(int)
        assert np.abs(wall - wall.mean()).max() < 12  # grey


def test_speed_rate_length_and_size(source, tmp_path):
    options = VideoOptions(path="camera", fps=20, speed=0.5, size=(240, 60))
    shown, rate, _ = read(made(source, tmp_path / "a.mp4", options, frames="1:3"))
    assert rate == 20
    assert shown.shape == (9, 60, 240, 3)  # 0.2 s, half as fast, and the last one
    column, row = pixel_of(3)
    assert shown[-1, row, column + 80] @ [1, -1, -1] > 90  # the camera's picture is in the middle
    options = VideoOptions(path="camera", seconds=0.8)
    shown = read(made(source, tmp_path / "b.mp4", options))[0]
    assert len(shown) == 8
    assert np.abs(shown[-1].astype(int) - shown[FRAMES - 1]).max() < 8  # the last frame stays


def test_states_between_frames(source, tmp_path):
    options = VideoOptions(path="camera", fps=20, interpolate=True)
    shown = read(made(source, tmp_path / "a.mp4", options))[0]
    column, row = pixel_of(1.5)
    reds = shown[3, row].astype(int) @ [1, -1, -1]
    assert np.average(np.arange(80), weights=np.maximum(reds, 0)) == pytest.approx(column, abs=1)


def test_an_orbit_begins_at_a_camera_and_turns_to_its_right(source, tmp_path):
    options = VideoOptions(camera="side", orbit_speed=np.degrees(0.6) / 0.4)
    shown = read(made(source, tmp_path / "a.mp4", options))[0]
    # The second camera stands to the left of the first.
    for frame, camera in ((0, "side"), (FRAMES - 1, "front")):
        column, row = pixel_of(frame, make_rig()[camera])
        assert shown[frame, row, column] @ [1, -1, -1] > 90


def test_a_track_is_drawn_where_it_projects_and_fades(source, tmp_path):
    size, camera = (320, 240), make_rig()["front"].scaled(4)
    plain = read(made(source, tmp_path / "a.mp4", VideoOptions(path="camera", size=size)))[0]
    shown = read(made(source, tmp_path / "b.mp4", VideoOptions(path="camera", size=size, tracks=1, trail=0.4)))[0]
    changed = np.abs(shown.astype(int) - plain).max(axis=-1)
    with CompactReader(source / "states.s4d") as reader:
        ways = np.stack([reader.state(frame).means[:BLOB] for frame in range(FRAMES)])
    pixels = camera.project(WORLD.to_user(ways))[0]
    ends = pixels[-1].astype(int)
    drawn = changed[-1, ends[:, 1], ends[:, 0]]
    (track,) = np.flatnonzero(drawn > 60)  # one of the four
    column, row = ends[track]
    assert np.abs(shown[-1, row, column].astype(int) - part_colour(0)).max() < 50  # 4:2:0 mixes it with the blob's red
    steps = (pixels[1:, track] + pixels[:-1, track]) / 2
    strength = [changed[-1, int(v) - 1 : int(v) + 2, int(u)].max() for u, v in steps]
    assert strength[0] > 8  # the first step is still there
    assert strength[1] < strength[2]  # and fainter than later ones; the last is before the blob
    away = np.ones(changed.shape[1:], bool)
    for u, v in np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(pixels[:, track])]):
        away[int(v) - 8 : int(v) + 9, int(u) - 8 : int(u) + 9] = False
    assert changed[-1][away].max() < 25


def test_parts_have_their_colours(source, tmp_path):
    shown = read(made(source, tmp_path / "a.mp4", VideoOptions(path="camera", parts=True)))[0]
    column, row = pixel_of(2)
    hue = colorsys.rgb_to_hsv(*shown[2, row, column] / 255)[0]
    assert hue == pytest.approx(colorsys.rgb_to_hsv(*np.array(part_colour(1)) / 255)[0], abs=0.04)


@pytest.mark.parametrize("camera", ["front", "side"])
def test_the_true_picture_is_at_the_right(source, tmp_path, true_capture, camera):
    """Of a training camera, and of one that was held out."""
    options = VideoOptions(path="camera", camera=camera, fps=20, size=(160, 60))
    shown = read(made(source, tmp_path / "a.mp4", options, compared=true_capture))[0]
    assert shown.shape[1:] == (60, 320, 3)
    for number, frame in ((0, 0), (2, 1), (7, 3), (8, 4)):  # of two that are as near the earlier
        true = shown[number, :, 160:].astype(int)
        assert np.abs(true[4:-4, 44:116] - true_colour(frame)).max() < 8
        assert true[:, :36].max() < 8  # the camera's picture is narrower
    column, row = pixel_of(0, make_rig()[camera])
    assert shown[0, row, column + 40] @ [1, -1, -1] > 90


def test_a_background_that_is_asked_for(source, tmp_path):
    for colour, wanted in ((None, BACKGROUND), ((1.0, 1.0, 0.0), (1, 1, 0))):
        options = VideoOptions(path="camera", size=(400, 60), background=colour)
        shown = read(made(source, tmp_path / "a.mp4", options, frames="0"))[0]
        assert np.abs(shown[0, 30, 4] / 255 - wanted).max() < 0.03


def test_a_scene_of_the_service(service, tmp_path):
    with Client(service.url, busy_timeout=HANG_S) as client:
        scene = client.create_scene(a_rig()).id
        try:
            for index in range(2):
                client.put_frame(scene, index, pictures(index))
                client.wait(scene, index, every=0.05)
            options = VideoOptions(path="camera", size=(48, 32), fps=60)
            made = make_video(scene, tmp_path / "a.mp4", options, url=service.url, token=None)
        finally:
            client.delete_scene(scene)
    assert read(made)[0].shape == (3, 32, 48, 3)


def test_tracks_of_what_stands_are_refused(tmp_path):
    with CompactWriter(tmp_path / "states.s4d", FileHeader(WORLD, rig=make_rig())) as writer:
        still = state(0)
        writer.add(0, 0.0, still.replace(foreground=0 * still.foreground))
    with pytest.raises(InputError, match="tracks: these frames contain no motion; omit --tracks"):
        made(tmp_path, tmp_path / "a.mp4", VideoOptions(path="camera", tracks=3))
    with pytest.raises(InputError, match="parts: states contains no parts; omit --parts"):
        made(tmp_path, tmp_path / "a.mp4", VideoOptions(path="camera", parts=True))
    assert [path.name for path in tmp_path.iterdir()] == ["states.s4d"]


def test_a_moment_from_all_around(source, tmp_path):
    options = VideoOptions(seconds=0.4, orbit_speed=900.0)
    shown = read(made(source, tmp_path / "a.mp4", options, frames="2"))[0]
    assert len(shown) == 4
    assert len({picture.tobytes() for picture in shown}) == 4


@pytest.mark.parametrize(
    ("out", "options", "more", "said"),
    [
        ("a.gif", FRONT, {}, r"out .*a.gif' has the unsupported suffix '.gif'; use .mp4 or .webp"),
        ("a.mp4", VideoOptions(path="camera", size=(63, 48)), {}, "size 63x48 .* odd dimension, .*; use 62x48, or"),
        ("a.mp4", VideoOptions(path="camera", camera="up"), {}, "camera 'up' does not exist; choose from front, side"),
        ("a.mp4", VideoOptions(path="way.json"), {}, "path 'way.json' is not a file; use orbit, camera, or a JSON"),
        ("a.mp4", FRONT, {"frames": "7:9"}, "states has no frames in the range 7:9; it contains frames 0 to 4"),
        ("a.mp4", VideoOptions(fps=200, speed=1e-6), {}, "speed 1e-06 result in 80000001 images; change --frames"),
        ("a.mp4", VideoOptions(), {"compared": True}, "compare cannot be used with path 'orbit'; use --path camera"),
        ("a.mp4", VideoOptions(path="camera", interpolate=True), {"compared": True}, "compare and interpolate are"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_and_nothing_is_left(source, tmp_path, true_capture, out, options, more, said):
    more = more | ({"compared": true_capture} if more.get("compared") else {})
    with pytest.raises(InputError, match=said):
        made(source, tmp_path / out, options, **more)
    assert not list(tmp_path.iterdir())


def test_a_size_names_its_remedy():
    for wrong in ("640", "0x0", "640x480x3", "9999x9999", "-640x480"):
        with pytest.raises(InputError, match="is not a valid image size; use WIDTHxHEIGHT, such as 1280x720"):
            picture_size(wrong)


def test_the_command(source, tmp_path):
    keys = {"keys": [{"frame": 0, "position": [100, -30, -100], "look_at": [100, -40, 230], "field_of_view": 30}]}
    (tmp_path / "keys.json").write_text(json.dumps(keys))
    arguments = ["video", str(source), "--path", str(tmp_path / "keys.json"), "--out", str(tmp_path / "a.webp")]
    done = CliRunner().invoke(app, [*arguments, "--size", "65x49", "--tracks", "2", "--parts", "--background", "white"])
    assert done.exit_code == 0, done.exception
    assert "5 images of 65x49, 0.5 s" in done.output
    with Image.open(tmp_path / "a.webp") as file:
        assert (file.size, file.n_frames) == ((65, 49), FRAMES)
    done = CliRunner().invoke(app, [*arguments, "--size", "65"])
    assert "size '65' is not a valid image size" in str(done.exception)
