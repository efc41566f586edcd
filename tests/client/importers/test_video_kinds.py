"""Videos whose packets are not their frames, or whose frames are not plain sRGB pictures of one size."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from films import FRAMES, SIZE, X265, barcode, check, encode, number
from lenses import camera, pose
from rigs import transforms, write

from client.importers.open_source import open_source
from client.importers.video import index as video_index
from client.importers.video.reader import Video
from client.rig.sequence import Sequence, ping_pong
from scas4d_core.captures import CaptureError, decode_image

av = pytest.importorskip("av")


def earlier(count):
    """Moves packets to times before 0, as FFmpeg does if it cuts without encoding: with an edit list."""

    def edit(packets):
        for packet in packets:
            packet.pts, packet.dts = packet.pts - count, packet.dts - count
        return packets

    return edit


def without(*places):
    return lambda packets: [packet for place, packet in enumerate(packets) if place not in places]


def rig(folder, film, *, size=SIZE, end="mp4"):
    """A capture of two cameras with the same video."""
    lenses = {name: camera("PINHOLE", name, pose(x)) for name, x in (("a", -0.1), ("b", 0.1))}
    numbers = {"w": size[0], "h": size[1], "fl_x": 60.0, "fl_y": 60.0, "cx": size[0] / 2, "cy": size[1] / 2}
    write(folder / "transforms.json", transforms(lenses, "PINHOLE", path="{}.png") | numbers)
    for name in lenses:
        film(folder / "videos" / f"{name}.{end}")
    return folder


@pytest.mark.parametrize("container", ["mp4", "mov"])
@pytest.mark.parametrize(
    ("codec", "options"),
    [("libx264", {"g": 30, "bf": 2}), ("libx265", {"preset": "ultrafast", "x265-params": X265 + ":open-gop=1"})],
)
def test_packets_hidden_by_an_edit_list_are_no_frames(tmp_path, codec, options, container):
    check(encode(tmp_path / f"a.{container}", codec, edit=earlier(5), **options), range(5, FRAMES))


@pytest.mark.parametrize("container", ["ts", "mkv", "mp4"])
def test_a_recording_that_begins_within_a_group_of_pictures(tmp_path, container):
    path = encode(tmp_path / f"a.{container}", "libx264", g=8, bf=2, edit=without(0, 1, 2))
    check(path, range(7, FRAMES))


def test_a_cut_at_an_open_group_of_pictures(tmp_path):
    def from_the_second_keyframe(packets):
        return packets[next(place for place, packet in enumerate(packets) if place and packet.is_keyframe) :]

    params = {"preset": "ultrafast", "x265-params": X265 + ":open-gop=1:bframes=3:b-adapt=0"}
    check(encode(tmp_path / "a.mp4", "libx265", edit=from_the_second_keyframe, **params), range(6, FRAMES))


def test_push_from_the_middle_and_back_and_forth_over_open_groups_of_pictures(tmp_path):
    params = {"preset": "ultrafast", "x265-params": X265 + ":open-gop=1:bframes=3:b-adapt=0"}
    capture = open_source(rig(tmp_path, lambda path: encode(path, "libx265", **params)), encoding="png")
    sequence = Sequence(capture, start=11, loop=True)
    for index in range(20):
        images = sequence.files(index).images
        assert {number(decode_image(image)) for image in images.values()} == {11 + ping_pong(index, FRAMES - 11)}
    sequence.close()


def test_streams_without_timestamps_have_evenly_spaced_frames(tmp_path):
    path = encode(tmp_path / "a.h264", "libx264", g=8, bf=2)
    check(path, range(FRAMES))
    video = Video(path)
    assert video.times[3] == pytest.approx(3 / 25)
    assert "spaced evenly, 25 per second" in video.remarks[0]


def test_joined_recordings_whose_times_begin_anew(tmp_path):
    one, two = (
        encode(tmp_path / f"{k}.ts", "libx264", frames, g=5, bf=2) for k, frames in enumerate(((1, 2, 3), (4, 5)))
    )
    path = tmp_path / "a.ts"
    path.write_bytes(one.read_bytes() + two.read_bytes())
    check(path, range(1, 6))
    assert (np.diff(Video(path).times) > 0).all()


def test_a_codec_without_a_decoder_is_named(tmp_path):
    path = encode(tmp_path / "a.mp4", "libx264")
    path.write_bytes(path.read_bytes().replace(b"avc1", b"zzzz"))
    with pytest.raises(CaptureError, match=r"a.mp4: FFmpeg has no decoder for its codec"):
        Video(path)


def test_odd_sizes(tmp_path):
    check(encode(tmp_path / "a.mkv", "ffv1", pix_fmt="yuv444p", draw=lambda index: barcode(index, (67, 49))), range(20))


def test_a_cover_is_not_the_video(tmp_path):
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        cover, film = container.add_stream("mjpeg", rate=25), container.add_stream("libx264", rate=25)
        cover.disposition = 0x400
        for stream, pix_fmt in ((cover, "yuvj420p"), (film, "yuv420p")):
            stream.width, stream.height, stream.pix_fmt = *SIZE, pix_fmt
        pictures = [av.VideoFrame.from_ndarray(barcode(index), "rgb24") for index in range(3)]
        packets = [*cover.encode(pictures[0]), *cover.encode()]
        for picture in pictures:
            packets += film.encode(picture)
        for packet in [*packets, *film.encode()]:
            container.mux(packet)
    video = Video(path)
    assert [number(video.frame(index)) for index in range(len(video))] == [0, 1, 2]


def test_a_size_that_changes_is_refused_with_its_frame(tmp_path):
    parts = [
        encode(tmp_path / f"{width}.ts", "libx264", range(4), draw=lambda index, w=width: barcode(index, (w, 48)))
        for width in (64, 96)
    ]
    path = tmp_path / "a.ts"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    with pytest.raises(CaptureError, match=r"a.ts: frame 4 is 96x48 pixels, but the frames before it are 64x48"):
        Video(path)


@pytest.mark.parametrize(("fields", "first"), [("tff", 0), ("bff", 1)])
def test_interlaced_frames_are_made_progressive_and_named(tmp_path, fields, first):
    """A bar moves between the fields: in the first it is on the left, in the second on the right."""

    def combed(index):
        picture = np.full((48, 64, 3), 20, np.uint8)
        picture[first::2, 8:24] = picture[1 - first :: 2, 40:56] = 220
        return picture

    def film(path):
        options = {"g": 4, "bf": 2, "crf": 1, "flags": "+ildct+ilme"}
        return encode(path, "libx264", range(6), draw=combed, fields=fields, **options)

    capture = open_source(rig(tmp_path, film), encoding="png")
    for index in (0, 5, 2, 3):
        picture = capture.frame(index).images["a"]
        assert picture[4:-4, 12:20].min() > 190
        assert picture[4:-4, 44:52].max() < 50
    assert any(remark.startswith("a.mp4, b.mp4: interlaced video") for remark in capture.remarks)


def hlg(level):
    """sRGB value of a grey in HLG, by ITU-R BT.2100 with a display of 1000 cd/m² and white at 203 cd/m² (BT.2408)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = level**2 / 3 if level <= 0.5 else (np.exp((level - c) / a) + b) / 12
    light = 1000 * scene**1.2 / 203
    return 255 * np.clip(12.92 * light if light < 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055, 0, 1)


def pq(level):
    """sRGB value of a grey in PQ, by SMPTE ST 2084 with white at 203 cd/m²."""
    m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
    root = level ** (1 / m2)
    light = 10000 * (max(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1) / 203
    return 255 * np.clip(12.92 * light if light < 0.0031308 else 1.055 * light ** (1 / 2.4) - 0.055, 0, 1)


@pytest.mark.parametrize(("name", "transfer", "curve"), [("HLG", 18, hlg), ("PQ", 16, pq)])
def test_hdr_is_converted_and_named(tmp_path, name, transfer, curve):
    levels = np.linspace(0.1, 0.9, 8)

    def film(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("ffv1", rate=25)
            stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p10le"
            context = stream.codec_context
            context.color_trc, context.color_primaries, context.colorspace, context.color_range = transfer, 9, 9, 1
            frame = av.VideoFrame(*SIZE, "yuv420p10le")
            for plane, values in zip(frame.planes, (np.rint(64 + 876 * levels), 512, 512), strict=True):
                lines = np.frombuffer(plane, np.uint16).reshape(plane.height, -1)[:, : plane.width]
                lines[:] = np.repeat(values, 8) if plane.width == SIZE[0] else values
            for packet in [*stream.encode(frame), *stream.encode()]:
                container.mux(packet)

    capture = open_source(rig(tmp_path, film, end="mkv"))
    picture = capture.frame(0).images["b"][24, 4::8].astype(float)
    assert np.abs(picture - np.array([curve(level) for level in levels])[:, None]).max() < 4
    assert any(
        remark.startswith(f"a.mkv, b.mkv: HDR video with the transfer curve {name}") for remark in capture.remarks
    )


def turned_by(degrees):
    def film(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=25)
            stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
            stream.set_display_rotation(degrees)
            picture = barcode(0)
            picture[:24, :32] = 255  # top left, as stored
            packets = [*stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")), *stream.encode()]
            container.mux(packets)
        return path

    return film


@pytest.mark.parametrize(("degrees", "corner"), [(90, (-6, 6)), (180, (-6, -6)), (-90, (6, -6))])
def test_pictures_are_turned_as_the_metadata_demand(tmp_path, degrees, corner):
    """FFmpeg's angle is counterclockwise: by 90°, the top left corner becomes the bottom left one."""
    size = SIZE if degrees == 180 else SIZE[::-1]
    capture = open_source(rig(tmp_path, turned_by(degrees), size=size))
    picture = capture.frame(0).images["a"]
    assert picture.shape == (size[1], size[0], 3)
    assert picture[corner].min() > 200
    assert (picture > 128).sum() < picture.size / 3
    assert any("a.mp4 is turned as its metadata demand" in remark for remark in capture.remarks)


def test_pictures_keep_the_orientation_of_the_calibration(tmp_path):
    capture = open_source(rig(tmp_path, turned_by(90), size=SIZE))
    assert capture.frame(0).images["a"][6, 6].min() > 200
    assert any("a.mp4 is not turned as its metadata demand" in remark for remark in capture.remarks)


def test_an_oblique_turn_is_refused(tmp_path):
    with pytest.raises(CaptureError, match=r"a.mp4: its metadata turn the picture by another angle"):
        Video(turned_by(30)(tmp_path / "a.mp4"))


def test_damaged_frames_are_named_and_not_returned(tmp_path, monkeypatch):
    path = encode(tmp_path / "a.mp4", "libx264", g=8, bf=0)
    data = bytearray(path.read_bytes())
    with av.open(str(path)) as container:
        packet = [packet for packet in container.demux(video=0) if packet.size][6]
    data[packet.pos + packet.size // 2 : packet.pos + packet.size] = bytes(packet.size - packet.size // 2)
    path.write_bytes(data)
    video = Video(path)
    assert "damaged frames, first frame 6 at 0.240 s" in video.remarks[0]
    assert number(video.frame(5)) == 5
    with pytest.raises(CaptureError, match=r"a.mp4: frame 6, at 0.240 s, is damaged"):
        video.frame(6)


def test_the_index_is_made_once(tmp_path, monkeypatch, video_cache):
    path = encode(tmp_path / "a.mp4", "libx264")
    Video(path).close()
    with monkeypatch.context() as patch:
        patch.setattr(video_index, "_decoded_index", None)  # cannot be called
        assert len(Video(path)) == FRAMES
    (cached,) = video_cache.iterdir()
    cached.write_bytes(cached.read_bytes()[:100])
    assert len(Video(path)) == FRAMES
    np.save(cached.with_suffix(".npy"), np.zeros(3))
    cached.with_suffix(".npy").replace(cached)  # a NumPy file that is no archive
    assert len(Video(path)) == FRAMES
    encode(path, "libx264", range(FRAMES + 5))
    assert len(Video(path)) == FRAMES + 5
    monkeypatch.setattr(video_index, "cache_folder", lambda: path / "no folder")
    assert len(Video(path)) == FRAMES + 5


def test_a_user_without_a_home_has_a_cache_too(monkeypatch):
    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.undo()  # the fixture that replaces the folder
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", home)
    assert video_index.cache_folder().parts[-2:] == ("scas4d", "videos")


def test_a_colon_in_a_relative_path_is_no_protocol(tmp_path, monkeypatch):
    encode(tmp_path / "day:1" / "a.mp4", "libx264")
    monkeypatch.chdir(tmp_path)
    assert number(Video(Path("day:1/a.mp4")).frame(3)) == 3


def test_frames_without_a_timestamp_at_the_end_are_spaced_evenly():
    stream = SimpleNamespace(average_rate=25, guessed_rate=25, time_base=Fraction(1, 100))
    seconds, spaced, rate = video_index._times(np.array([0, 4, 8, video_index.NO_STAMP]), stream)
    assert (seconds.tolist(), spaced, rate) == ([0, 1 / 25, 2 / 25, 3 / 25], True, 25)
