"""Frames from one video per camera, with a common frame rate and start time."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from client.importers.calibration import Calibration
from client.importers.source import Picture
from client.importers.video.reader import Video
from scas4d_core.cameras import minimum_cameras
from scas4d_core.captures import CaptureError
from scas4d_core.captures.images import mixed_colours

RATE_TOLERANCE = 1e-3
"""Maximum relative difference between the frame rates of two cameras, roughly that between 29.97 and 30."""
ALIKE = 0.05
"""Relative difference below which two frame intervals count as equal, because timestamps are rounded."""


class Videos:
    """Reader for one video per camera, with a common frame rate and start time.

    The capture ends when fewer than half of the cameras have another frame. A camera whose video cannot be read, or
    ends before, has no image in the other frames.

    Attributes:
        sizes: (width, height) of the pictures of each readable video, keyed by camera name.

    Raises:
        CaptureError: if fewer than half of the videos can be read, the frame rates differ, or the frame times of two
            videos are more than half a frame apart.
    """

    def __init__(self, calibration: Calibration, files: Mapping[str, Path]) -> None:
        # The first time, opening a video decodes it to make its index.
        with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="videos") as pool:
            opened = dict(
                zip(calibration.names, pool.map(_open, (files[camera] for camera in calibration.names)), strict=True)
            )
        self._videos = {camera: video for camera, video in opened.items() if isinstance(video, Video)}
        self._faults = {camera: fault for camera, fault in opened.items() if isinstance(fault, CaptureError)}
        least = minimum_cameras(len(opened))
        if len(self._videos) < least:
            raise next(iter(self._faults.values()))
        self.frame_count = sorted(map(len, self._videos.values()), reverse=True)[least - 1]
        first = next(video for video in self._videos.values() if len(video) >= self.frame_count)
        self.fps: float | None = first.fps or None
        self._times = first.times
        for video in self._videos.values():
            self._check_together(video, first)
        self.remarks = [
            f"{video.path.name} has {len(video) - self.frame_count} more frames than most videos; they are ignored"
            for video in self._videos.values()
            if len(video) > self.frame_count
        ]
        self.remarks += self._turns(calibration) + self._conversions()
        self.sizes = {camera: video.size for camera, video in self._videos.items()}
        self.remarks += mixed_colours({camera: video.grey for camera, video in self._videos.items()})

    def _turns(self, calibration: Calibration) -> list[str]:
        """Decides whether to turn the pictures as the metadata demand, and returns remarks on it.

        Players, FFmpeg and OpenCV turn them, and so do most calibration tools. If a camera was calibrated for portrait
        images but turning gives landscape images, or the other way round, the stored orientation is right.
        """
        remarks = []
        for lens in calibration.cameras:
            video = self._videos.get(lens.name)
            if video is None or np.array_equal(video.turn, np.eye(2)):
                continue
            width, height = video.size
            if (width - height) * (lens.width - lens.height) < 0:
                video.turn = np.eye(2, dtype=np.int8)
                how = f"not turned as its metadata demand, because its camera is calibrated for {height}x{width} pixels"
            else:
                how = "turned as its metadata demand; if its camera was calibrated without turning, remove the metadata"
            remarks.append(f"{video.path.name} is {how}")
        return remarks

    def _conversions(self) -> list[str]:
        """Returns the remarks of all videos; each names the files that it applies to."""
        files: dict[str, list[str]] = {}
        for video in self._videos.values():
            for remark in video.remarks:
                files.setdefault(remark, []).append(video.path.name)
        return [f"{', '.join(names)}: {remark}" for remark, names in files.items()]

    def _check_together(self, video: Video, first: Video) -> None:
        count = min(len(video), len(first))
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
        """Returns the video file of a camera in `sizes`."""
        return self._videos[camera].path

    def file(self, index: int, camera: str) -> None:
        """Returns None, because a video frame has no file of its own."""
        return None

    def decoded(self, index: int, camera: str) -> Picture:
        """Returns the decoded image [H, W, 3] of a camera and frame.

        Raises:
            CaptureError: if the video cannot be read, has ended, or the frame is damaged.
        """
        if camera in self._faults:
            raise self._faults[camera]
        video = self._videos[camera]
        if index >= len(video):
            raise CaptureError(f"{video.path} {video.end}")
        return video.frame(index)


def _open(path: Path) -> Video | CaptureError:
    """Returns a video, or the reason why it cannot be read."""
    try:
        return Video(path)
    except CaptureError as fault:
        return fault
