"""Conversion of decoded video frames to upright, progressive sRGB pictures, where the metadata demand it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.extras import pyav
from client.importers.video.index import VideoIndex
from scas4d_core.captures import CaptureError

Picture = NDArray[np.uint8]

PQ, HLG = 16, 18
HDR = {PQ: "PQ (SMPTE ST 2084)", HLG: "HLG (ARIB STD-B67)"}
UNUSUAL = {4: "gamma 2.2", 5: "gamma 2.8", 8: "linear light", 9: "a logarithmic curve", 10: "a logarithmic curve"}
UNUSUAL |= {17: "SMPTE ST 428"}
"""Transfer characteristics (ITU-T H.273) that differ from those of ordinary video."""
TO_SRGB = "out_transfer=iec61966-2-1:out_primaries=bt709"


def conversion_remarks(index: VideoIndex) -> list[str]:
    """Returns remarks on how the pictures of a video are converted, or on what is not converted."""
    remarks = []
    if index.interlaced:
        remarks.append(
            "interlaced video: only the first field of each frame is used, and its missing lines are interpolated; "
            "record progressive video for the full vertical resolution"
        )
    if index.transfer in HDR:
        remarks.append(
            f"HDR video with the transfer curve {HDR[index.transfer]}: converted to sRGB; values above diffuse white "
            "are clipped"
        )
    if index.transfer in UNUSUAL:
        remarks.append(
            f"video with the transfer curve {UNUSUAL[index.transfer]}: its values are used as if they were sRGB; "
            "convert it if other cameras differ"
        )
    if index.damaged.any():
        first = int(np.argmax(index.damaged))
        remarks.append(
            f"{int(index.damaged.sum())} damaged frames, first frame {first} at {index.seconds[first]:.3f} s; they are "
            "left out"
        )
    if index.spaced:
        remarks.append(f"video without increasing timestamps: its frames are spaced evenly, {index.rate:g} per second")
    return remarks


class Pixels:
    """Converter for the frames of one video. Frames that need no conversion are left to `VideoStream.rgb`.

    Args:
        path: video file, for messages.
        index: index of the video.
    """

    def __init__(self, path: Path, index: VideoIndex) -> None:
        self._path = path
        self._hdr = index.transfer in HDR
        self._av = pyav()
        self._to_srgb: Any = None

    def converted(self, frame: Any) -> Any:
        """Returns an interlaced or HDR frame as a progressive sRGB frame, and other frames unchanged.

        Raises:
            CaptureError: if FFmpeg lacks a filter.
        """
        try:
            if frame.interlaced_frame:
                # This filter uses only the frame itself, so the result does not depend on the order of reading. It
                # returns a frame once it receives the next one, or the end.
                graph = self._graph(frame, ("estdif", "mode=frame"))
                graph.push(frame)
                graph.push(None)
                frame = graph.pull()
            if self._hdr:
                self._to_srgb = self._to_srgb or self._graph(frame, ("scale", TO_SRGB), ("format", "rgb24"))
                self._to_srgb.push(frame)
                frame = self._to_srgb.pull()
        except (self._av.FFmpegError, ValueError) as fault:
            raise CaptureError(
                f"{self._path}: FFmpeg {self._av.ffmpeg_version_info} cannot convert its interlaced or HDR frames "
                f"({fault}); install a newer PyAV (av), or convert the video to progressive SDR"
            ) from fault
        return frame

    def _graph(self, frame: Any, *filters: tuple[str, str]) -> Any:
        graph = self._av.filter.Graph()
        last = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base)
        for name, options in filters:
            following = graph.add(name, options)
            last.link_to(following)
            last = following
        last.link_to(graph.add("buffersink"))
        graph.configure()
        return graph


def turned(picture: Picture, turn: NDArray[np.int8]) -> Picture:
    """Returns a picture [H, W, 3] turned or mirrored by a matrix [2, 2] that acts on pixel positions (x, y).

    >>> picture = np.arange(6, dtype=np.uint8).reshape(2, 3)[..., None].repeat(3, axis=2)
    >>> turned(picture, np.array([[0, -1], [1, 0]], np.int8))[..., 0]  # clockwise
    array([[3, 0],
           [4, 1],
           [5, 2]], dtype=uint8)
    """
    if turn[0, 0] == 0:
        picture = picture.transpose(1, 0, 2)
    across, down = turn.sum(axis=1)
    return np.ascontiguousarray(picture[::down, ::across])
