"""The video stream of one file, decoded in order with PyAV."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.extras import pyav
from scas4d_core.captures import CaptureError

ATTACHED_PICTURE = 0x400
"""FFmpeg's AV_DISPOSITION_ATTACHED_PIC, which marks a cover or thumbnail stored as a video stream."""


class VideoStream:
    """The first video stream of a file. Covers and thumbnails do not count.

    Attributes:
        path: video file.
        stream: PyAV's stream.

    Raises:
        CaptureError: if the file cannot be opened, has no video stream, or has a codec without a decoder.
        MissingExtraError: if PyAV is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._av = pyav()
        try:
            # In a relative path, FFmpeg takes what precedes a colon for a protocol.
            self._container = self._av.open(str(path.absolute()))
        except self._av.FFmpegError as fault:
            raise unreadable(path, fault) from fault
        streams = [stream for stream in self._container.streams.video if not stream.disposition & ATTACHED_PICTURE]
        if not streams:
            self._container.close()
            raise CaptureError(f"{path} has no video stream")
        self.stream: Any = streams[0]
        if self.stream.codec_context is None:
            self._container.close()
            raise CaptureError(f"{path}: FFmpeg has no decoder for its codec; convert it to H.264")
        # The cameras of a rig are decoded in parallel. More threads per camera would only compete with each other.
        self.stream.codec_context.thread_count = 1
        self._reformatter = self._av.video.reformatter.VideoReformatter()

    def frames(self) -> Iterator[Any]:
        """Decodes from the current position to the end, and yields PyAV frames, or None for a packet that fails.

        Raises:
            CaptureError: if the file cannot be read.
        """
        try:
            for packet in self._container.demux(self.stream):
                try:
                    yield from packet.decode()
                except self._av.error.InvalidDataError:
                    yield None
        except self._av.FFmpegError as fault:
            raise unreadable(self.path, fault) from fault

    def seek(self, stamp: int) -> bool:
        """Seeks to a timestamp, in units of the stream's time base. The demuxer decides where decoding then starts.

        Returns:
            False if the container does not support seeking.
        """
        try:
            self._container.seek(stamp, stream=self.stream, backward=True)
        except self._av.FFmpegError:
            return False
        return True

    def rgb(self, frame: Any) -> NDArray[np.uint8]:
        """Returns a frame as [H, W, 3], with the colour matrix and range of its metadata.

        The conversion is set up once per stream. PyAV's `to_ndarray` would do so for each frame.
        """
        return np.ascontiguousarray(self._reformatter.reformat(frame, format="rgb24").to_ndarray())

    def close(self) -> None:
        """Closes the file."""
        self._container.close()


def unreadable(path: Path, fault: Exception) -> CaptureError:
    """Returns the error for a file that FFmpeg cannot open or read."""
    return CaptureError(f"{path} cannot be read as video: {fault}")
