"""Video: exactly the frame asked for, whatever the order of asking; what does not belong together is refused."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from films import barcode, number
from lenses import HEIGHT, WIDTH
from rigs import NAMES, lenses, transforms, write

from client.importers import source
from client.importers.extras import MissingExtraError
from client.importers.open_source import open_source
from client.importers.video.reader import Video
from scas4d_core.captures import CaptureError, decode_image

av = pytest.importorskip("av")

FRAMES = 25


def film(path, frames=range(FRAMES), rate=25, size=(WIDTH, HEIGHT), skip=(), codec="libx264"):
    """A video with B-frames and few key frames; `skip` leaves gaps in its times."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = {"g": "12", "bf": "3"}
        stream.time_base = Fraction(1, 1000 * int(rate))
        for place, index in enumerate(frames):
            if place in skip:
                continue
            frame = av.VideoFrame.from_ndarray(barcode(index, size), "rgb24")
            frame.pts, frame.time_base = place * 1000, stream.time_base
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@pytest.fixture
def rig_of_videos(tmp_path):
    write(tmp_path / "transforms.json", transforms(lenses("PINHOLE"), "PINHOLE", path="{}.png"))
    for name in NAMES:
        film(tmp_path / "videos" / f"{name}.mp4")
    return tmp_path


def test_frames_come_exactly_in_any_order(tmp_path):
    video = Video(film(tmp_path / "a.mp4", range(40)))
    assert len(video) == 40
    assert video.fps == pytest.approx(25)
    assert video.times[7] == pytest.approx(7 / 25)
    order = [*range(0, 8), 30, 31, 3, 39, 39, 0, 20, 12, 11, 13, *np.random.default_rng(0).integers(0, 40, 30)]
    assert [number(video.frame(int(index))) for index in order] == order
    video.close()


def test_comparing_each_frame_with_frame_0_decodes_each_once(tmp_path):
    video = Video(film(tmp_path / "a.mp4", range(40)))
    met = []
    own = video._stream.rgb
    video._stream.rgb = lambda frame: met.append(frame.pts) or own(frame)
    for index in range(40):
        assert (number(video.frame(index)), number(video.frame(0)), number(video.frame(index))) == (index, 0, index)
    # Frame 0 is decoded twice: it is kept once it was asked for again. Frame 1 is then found anew.
    assert len(met) <= 40 + 2
    assert video.frame(0) is video.frame(0)
    video.close()


def test_reading_backwards_decodes_each_frame_once(tmp_path):
    video = Video(film(tmp_path / "a.mp4", range(40)))
    decoded = []
    own = video._stream.frames
    video._stream.frames = lambda: (decoded.append(frame.pts) or frame for frame in own())
    for index in reversed(range(40)):
        assert number(video.frame(index)) == index
    assert len(decoded) <= 40
    video.close()


def test_colours_come_back(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt, stream.options = 64, 48, "yuv444p", {"crf": "0"}
        stream.codec_context.colorspace, stream.codec_context.color_range = 1, 1  # BT.709, as cameras write
        picture = np.full((48, 64, 3), (200, 60, 20), np.uint8)
        frame = av.VideoFrame.from_ndarray(picture, "rgb24").reformat(
            format="yuv444p", dst_colorspace=1, dst_color_range=1
        )
        frame.colorspace, frame.color_range = 1, 1
        for packet in [*stream.encode(frame), *stream.encode()]:
            container.mux(packet)
    assert np.abs(Video(path).frame(0).astype(int) - picture).max() <= 2


def test_jpeg_files_are_the_same_without_opencv(monkeypatch):
    picture = np.random.default_rng(0).integers(0, 256, (24, 40, 3), np.uint8)
    with_opencv = decode_image(source.encode(picture, "jpeg"))

    def missing():
        raise MissingExtraError("no OpenCV")

    monkeypatch.setattr(source, "opencv", missing)
    difference = with_opencv.astype(int) - decode_image(source.encode(picture, "jpeg"))
    assert np.abs(difference).max() <= 2
    assert np.abs(with_opencv.astype(int) - picture).mean() < 8  # colours in order, no chroma subsampling


def test_a_rig_of_videos_is_a_source(rig_of_videos):
    source = open_source(rig_of_videos, encoding="png")
    assert (source.frame_count, source.rig.names) == (FRAMES, ("cam1", "cam2", "cam10"))
    assert source.fps == pytest.approx(25)
    assert source.time(3) == pytest.approx(3 / 25)
    for index in (0, 1, 17, 16):
        assert {number(decode_image(source.encoded_image(index, name))) for name in NAMES} == {index}
    assert open_source(rig_of_videos).encoded_image(5, "cam1").startswith(b"\xff\xd8")


@pytest.mark.parametrize("path", ["videos/{}.mp4", "./{}.MOV", "{}"])
def test_a_calibration_may_name_videos(rig_of_videos, path):
    write(rig_of_videos / "transforms.json", transforms(lenses("PINHOLE"), "PINHOLE", path=path))
    capture = open_source(rig_of_videos)
    assert set(capture.rig.names) == set(NAMES)
    assert number(capture.frame(1).images[NAMES[0]]) == 1


def test_frames_of_videos_reach_the_reconstruction_scaled(rig_of_videos):
    capture = open_source(rig_of_videos, image_scale=0.5, test=("cam2",))
    assert (capture.rig.names, capture.test_rig.names) == (("cam1", "cam10"), ("cam2",))
    for index in (0, 7, 8, 3):
        frame = capture.frame(index)
        assert {number(frame.images[name]) for name in capture.rig.names} == {index}
        assert frame.images["cam1"].shape == (HEIGHT // 2, WIDTH // 2, 3)
        assert number(capture.test_frame(index).images["cam2"]) == index
        assert frame.time == pytest.approx(index / 25)


def test_a_longer_video_is_cut_and_said_so(rig_of_videos):
    film(rig_of_videos / "videos/cam2.mp4", range(FRAMES + 2))
    source = open_source(rig_of_videos)
    assert source.frame_count == FRAMES
    assert list(source.remarks) == ["cam2.mp4 has 2 more frames than most videos; they are ignored"]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda f: film(f / "cam2.mp4", rate=30), r"cam2.mp4 has 30 frames per second, but cam1.mp4 has 25"),
        (lambda f: film(f / "cam2.mp4", size=(152, 240)), r"cam2.mp4 is 152x240 pixels.*calibrated for 320x240"),
        (
            lambda f: film(f / "cam2.mp4", skip=(10,), rate=25),
            r"cam2.mp4: frame 10 is at 0.440 s, but in cam1.mp4 at 0.400 s",
        ),
        (
            lambda f: (f / "cam2.mp4").rename(f / "two.mp4"),
            r"no video of camera 'cam2' of .*transforms.json, but it contains two, .* name each video after its camera",
        ),
        (lambda f: (f / "cam2.mkv").write_bytes(b"x"), r"contains cam2.mkv and cam2.mp4 for the same camera"),
        (lambda f: [(f / f"{name}.mp4").write_bytes(b"") for name in NAMES[:2]], r"mp4 cannot be read as video"),
    ],
)
def test_what_does_not_belong_together_is_named(rig_of_videos, damage, said):
    damage(rig_of_videos / "videos")
    with pytest.raises(CaptureError, match=said):
        open_source(rig_of_videos)


def test_a_damaged_video_ends_before_the_frame_that_is_lost(tmp_path):
    path = film(tmp_path / "a.mkv", range(60))
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + len(data) // 4] = bytes(len(data) // 4)
    path.write_bytes(data)
    video = Video(path)
    assert 12 < len(video) < 60
    assert [number(video.frame(index)) for index in range(len(video))] == list(range(len(video)))
