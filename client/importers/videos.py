"""Frames from one video per camera, decoded on demand with PyAV.

Frame times are read from the packets, without decoding. To decode a frame, the reader seeks to the preceding keyframe
and decodes up to the frame's timestamp. Sequential access decodes each frame once.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import Calibration
from client.importers.extras import pyav
from client.importers.source import Picture
from scas4d_core.captures import CaptureError
from scas4d_core.captures.images import mixed_colours

ENDS = (".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v", ".mts", ".ts")
RATE_TOLERANCE = 1e-3
"""Maximum relative difference between the frame rates of two cameras, roughly that between 29.97 and 30."""
NEAR = 8
"""Maximum number of frames to skip by decoding them. For larger steps, seeking to a keyframe is usually faster."""
ALIKE = 0.05
"""Relative difference below which two frame intervals count as equal, because timestamps are rounded."""


class Video:
    """Reader for the frames of one video file.

    Attributes:
        times: [T] time of each frame in seconds, relative to the first.
        fps: mean frame rate.
        size: (width, height) in pixels.
        grey: whether the pixel format is greyscale.

    Raises:
        CaptureError: if the file has no video stream, is damaged, or has no frame with a timestamp.
        MissingExtraError: if PyAV is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._av = pyav()
        self._lock = threading.Lock()
        self._decoding: Iterator[Any] = iter(())
        self._next = -1
        self._last: tuple[int, Picture] | None = None
        self._kept: tuple[int, Picture] | None = None
        try:
            self._container = self._av.open(str(path))
            if not self._container.streams.video:
                raise CaptureError(f"{path} has no video stream")
            self._stream = self._container.streams.video[0]
            self._stamps = sorted(
                packet.pts for packet in self._container.demux(self._stream) if packet.pts is not None
            )
        except self._av.FFmpegError as fault:
            raise CaptureError(f"{path} cannot be read as video: {fault}") from fault
        if not self._stamps:
            raise CaptureError(f"{path} has no frames with timestamps")
        base = float(self._stream.time_base)
        self.times: NDArray[np.float64] = (np.array(self._stamps) - self._stamps[0]) * base
        self.size = (int(self._stream.codec_context.width), int(self._stream.codec_context.height))
        self.grey = (self._stream.codec_context.pix_fmt or "").startswith("gray")
        rate = self._stream.average_rate or 0
        self.fps = (len(self) - 1) / self.times[-1] if len(self) > 1 else float(rate)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def interval(self) -> float:
        """Median interval between consecutive frames in seconds, which dropped frames do not affect."""
        return float(np.median(np.diff(self.times))) if len(self) > 1 else 0.0

    def frame(self, index: int) -> Picture:
        """Returns frame `index` as a read-only array [H, W, 3] of sRGB values.

        Two frames are cached: the most recent one, and the most recent one reached by stepping back. Scoring compares
        every frame with frame 0. Without the cache, each comparison would decode all frames since the preceding
        keyframe again.

        Raises:
            CaptureError: if the frame cannot be decoded, or the video's metadata rotates it.
        """
        with self._lock:
            for cached in (self._last, self._kept):
                if cached is not None and cached[0] == index:
                    return cached[1]
            again = self._last is not None and index < self._last[0]
            picture = self._decoded(index)
            picture.setflags(write=False)
            if again:
                self._kept = (index, picture)
            self._last = (index, picture)
            return picture

    def _decoded(self, index: int) -> Picture:
        wanted = self._stamps[index]
        try:
            if not 0 <= self._next <= index <= self._next + NEAR:
                self._container.seek(wanted, stream=self._stream, backward=True)
                self._decoding = self._container.decode(self._stream)
            for frame in self._decoding:
                if frame.pts == wanted:
                    self._next = index + 1
                    return self._pixels(frame)
                if frame.pts is not None and frame.pts > wanted:
                    break
        except self._av.FFmpegError as fault:
            self._next = -1
            raise CaptureError(f"{self.path}: frame {index} cannot be decoded ({fault})") from fault
        self._next = -1
        raise CaptureError(f"{self.path}: frame {index}, at {self.times[index]:.3f} s, cannot be decoded")

    def _pixels(self, frame: Any) -> Picture:
        if frame.rotation:
            raise CaptureError(
                f"{self.path}: its metadata rotates the image by {frame.rotation}°, and it is unknown whether the "
                "calibration used rotated images; store the pixels as calibrated and remove the rotation"
            )
        picture: Picture = frame.to_ndarray(format="rgb24")
        return picture

    def close(self) -> None:
        """Closes the file."""
        self._container.close()


class Videos:
    """Reader for one video per camera, with a common frame rate and start time.

    The shortest video determines the number of frames.

    Raises:
        CaptureError: if the frame rates differ, or the frame times of two videos are more than half a frame apart.
    """

    def __init__(self, calibration: Calibration, files: Mapping[str, Path]) -> None:
        self._videos = {camera: Video(files[camera]) for camera in calibration.names}
        self.frame_count = min(len(video) for video in self._videos.values())
        first = self._videos[calibration.names[0]]
        self.fps: float | None = first.fps or None
        self.sizes = {camera: video.size for camera, video in self._videos.items()}
        self._times = first.times
        for video in self._videos.values():
            self._check_together(video, first)
        self.remarks = [
            f"{video.path.name} has {len(video) - self.frame_count} more frames than the shortest video; they are "
            "ignored"
            for video in self._videos.values()
            if len(video) > self.frame_count
        ] + mixed_colours({camera: video.grey for camera, video in self._videos.items()})

    def _check_together(self, video: Video, first: Video) -> None:
        count = self.frame_count
        if count > 1 and np.isclose(video.interval, first.interval, rtol=ALIKE):
            apart = np.abs(video.times[:count] - first.times[:count])
            late = int(np.argmax(apart > first.interval / 2))
            if apart[late] > first.interval / 2:
                raise CaptureError(
                    f"{video.path}: frame {late} is at {video.times[late]:.3f} s, but in {first.path.name} at "
                    f"{first.times[late]:.3f} s, more than half a frame apart: frames were dropped, or the rates "
                    f"differ ({video.fps:.5g} and {first.fps:.5g} frames per second); trim the videos to match, or "
                    "repair them"
                )
        if abs(video.fps - first.fps) >= RATE_TOLERANCE * first.fps:
            raise CaptureError(
                f"{video.path} has {video.fps:.4g} frames per second, but {first.path.name} has {first.fps:.4g}; "
                "the cameras of a rig must be synchronized: convert the videos to one frame rate"
            )

    def time(self, index: int) -> float | None:
        """Returns the time of a frame in seconds since the first frame."""
        return float(self._times[index])

    def path(self, camera: str) -> Path:
        """Returns the video file of a camera."""
        return self._videos[camera].path

    def file(self, index: int, camera: str) -> Path | None:
        """Returns None, because a video frame has no file of its own."""
        return None

    def decoded(self, index: int, camera: str) -> Picture:
        """Returns the decoded image [H, W, 3] of a camera and frame."""
        return self._videos[camera].frame(index)
