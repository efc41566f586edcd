"""Containers × codecs × GOP structures: in any order, a video gives the pictures that reading in order gives."""

from __future__ import annotations

import pytest
from films import FRAMES, X265, check, encode

pytest.importorskip("av")

FRAGMENTS = {"movflags": "frag_every_frame+empty_moov+default_base_moof"}
CONTAINERS = {
    "mp4": {},
    "mov": {},
    "fragmented.mp4": {"muxing": FRAGMENTS},
    "mkv": {},
    "webm": {},
    "avi": {},
    "ts": {},
    "m2ts": {"muxing": {"mpegts_m2ts_mode": "1"}, "form": "mpegts"},
    "mpg": {"form": "vob"},
    "flv": {},
    "h264": {},
    "mjpeg": {},
}
CODECS = {
    "h264 intra": ("libx264", {"g": 1}),
    "h264 closed": ("libx264", {"g": 6, "bf": 0}),
    "h264 B": ("libx264", {"g": 6, "bf": 2}),
    "h264 pyramid": ("libx264", {"g": 30, "bf": 3, "x264-params": "b-pyramid=normal:ref=4:b-adapt=0"}),
    "h264 open": ("libx264", {"g": 6, "bf": 3, "x264-params": "open-gop=1:b-adapt=0"}),
    "h264 refresh": ("libx264", {"g": 8, "bf": 0, "intra-refresh": 1}),
    "hevc closed": ("libx265", {"preset": "ultrafast", "x265-params": f"{X265}:no-open-gop=1:bframes=0"}),
    "hevc B": ("libx265", {"preset": "ultrafast", "x265-params": f"{X265}:no-open-gop=1:bframes=3:b-adapt=0"}),
    "hevc open": ("libx265", {"preset": "ultrafast", "x265-params": f"{X265}:open-gop=1:bframes=3:b-adapt=0"}),
    "mpeg4": ("mpeg4", {"g": 6, "q": 3}),
    "mpeg4 B": ("mpeg4", {"g": 6, "bf": 2}),
    "mpeg2": ("mpeg2video", {"g": 6}),
    "mpeg2 open": ("mpeg2video", {"g": 6, "bf": 2}),
    "mjpeg": ("mjpeg", {"pix_fmt": "yuvj420p"}),
    "ffv1": ("ffv1", {"pix_fmt": "yuv444p", "g": 5}),
    "prores": ("prores_ks", {"pix_fmt": "yuv422p10le"}),
    "raw": ("rawvideo", {"pix_fmt": "bgr24"}),
    "huffyuv": ("huffyuv", {"pix_fmt": "yuv422p"}),
    "palette": ("rawvideo", {"pix_fmt": "pal8"}),
    "vp8": ("libvpx", {"g": 8, "auto-alt-ref": 1, "lag-in-frames": 6, "cpu-used": 8}),
    "vp9": ("libvpx-vp9", {"g": 8, "auto-alt-ref": 1, "lag-in-frames": 6, "cpu-used": 8}),
    "av1": ("libsvtav1", {"g": 8, "preset": 12, "svtav1-params": "lp=1"}),
}
HELD = {  # containers of each codec family
    "h264": ("mp4", "mov", "fragmented.mp4", "mkv", "avi", "ts", "m2ts", "flv", "h264"),
    "hevc": ("mp4", "mov", "fragmented.mp4", "mkv", "ts", "m2ts"),
    "mpeg4": ("mp4", "mkv", "avi", "ts"),
    "mpeg2": ("mp4", "mkv", "avi", "ts", "mpg"),
    "mjpeg": ("mov", "mkv", "avi", "mjpeg"),
    "ffv1": ("mkv", "avi"),
    "prores": ("mov", "mkv"),
    "raw": ("mov", "avi"),
    "palette": ("avi", "mov"),
    "huffyuv": ("avi",),
    "vp8": ("webm", "mkv"),
    "vp9": ("webm", "mkv", "mp4", "fragmented.mp4"),
    "av1": ("mp4", "webm", "mkv"),
}
MATRIX = [(codec, container) for codec in CODECS for container in HELD[codec.split()[0]]]


def test_the_matrix_is_large():
    assert len(MATRIX) >= 60


@pytest.mark.parametrize(("codec", "container"), MATRIX, ids=[" ".join(pair) for pair in MATRIX])
def test_by_index_is_in_order(tmp_path, codec, container):
    encoder, options = CODECS[codec]
    check(encode(tmp_path / f"a.{container}", encoder, **options, **CONTAINERS[container]), range(FRAMES))
