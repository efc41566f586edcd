"""Reader for the frames of one video in any order, which returns exactly the pictures of decoding from the start."""

from __future__ import annotations

import threading
import zlib
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.video.index import NO_STAMP, video_index
from client.importers.video.pixels import Picture, Pixels, conversion_remarks, turned
from client.importers.video.stream import VideoStream
from scas4d_core.captures import CaptureError

NEAR = 8
"""Maximum number of frames to skip by decoding them. For larger steps, seeking to a keyframe is usually faster."""
SEEKS = 3
"""Keyframes to try, from the nearest backwards, before decoding from the start of the file."""
PASSED_BYTES = 16 << 20
"""Size of the decoded frames to keep that were skipped on the way to a frame, for reading backwards."""


class Video:
    """Reader for the visible frames of one video file.

    Reading in order decodes the file once, without a seek. For other orders, the reader seeks to a keyframe. A demuxer
    may land after it, and a decoder may return frames whose references are missing. Frames decoded after a seek are
    therefore compared with the checksums of the index. If they differ, the reader tries earlier keyframes, and finally
    decodes from the start.

    Attributes:
        path: video file.
        times: [T] time of each frame in seconds, relative to the first.
        fps: mean frame rate.
        size: (width, height) in pixels.
        grey: whether the pixel format is greyscale.
        turn: [2, 2] matrix that `frame` applies to pixel positions (x, y), as the metadata demand.
        remarks: messages for the user about conversions of the pictures.

    Raises:
        CaptureError: if the file has no video stream, is damaged, or has no frame that can be decoded.
        MissingExtraError: if PyAV is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._index = index = video_index(path)
        self.times = index.seconds
        self.fps = (len(self) - 1) / self.times[-1] if len(self) > 1 else index.rate
        self.grey = index.grey
        self.remarks = conversion_remarks(index)
        self.turn = index.turn
        self._pixels = Pixels(path, index)
        self._order = np.argsort(index.stamps)  # in AVI files with B-frames, timestamps are those of other frames
        self._sorted = index.stamps[self._order]
        self._can_seek = bool((np.diff(self._sorted) > 0).all()) and self._sorted[0] != NO_STAMP
        self._most_passed = max(1, PASSED_BYTES // (3 * index.width * index.height))
        self._passed: deque[tuple[int, Any]] = deque()
        self._lock = threading.Lock()
        self._start()
        self._last: tuple[int, Picture] | None = None
        self._kept: tuple[int, Picture] | None = None

    def __len__(self) -> int:
        return len(self._index)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the pictures in pixels."""
        width, height = np.abs(self.turn) @ (self._index.width, self._index.height)
        return int(width), int(height)

    @property
    def end(self) -> str:
        """What follows the last frame, for messages that start with the path."""
        if self._index.lost:
            return f"is not used from frame {len(self)} on, which cannot be decoded"
        return f"ends after {len(self)} frames"

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
            CaptureError: if the frame is damaged, or the file has changed.
            IndexError: if the frame does not exist.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path} has the frames 0…{len(self) - 1}; got {index}")
        with self._lock:
            for cached in (self._last, self._kept):
                if cached is not None and cached[0] == index:
                    return cached[1]
            again = self._last is not None and index < self._last[0]
            picture = self._read(index)
            picture.setflags(write=False)
            if again:
                self._kept = (index, picture)
            self._last = (index, picture)
            return picture

    def _read(self, index: int) -> Picture:
        if self._index.damaged[index]:
            raise CaptureError(f"{self.path}: frame {index}, at {self.times[index]:.3f} s, is damaged")
        for place, frame in self._passed:
            if place == index:
                picture = self._picture(index, frame, certain=False)
                if picture is not None:
                    return picture
        if self._continues_to(index):
            picture = self._advance(index)
            if picture is not None:
                return picture
        if self._can_seek:
            for key in self._keys_before(index):
                if self._seek(key):
                    picture = self._advance(index)
                    if picture is not None:
                        return picture
        self.close()
        self._start()
        picture = self._advance(index)
        if picture is None:
            raise CaptureError(f"{self.path}: frame {index} cannot be decoded; the file has changed while it was read")
        return picture

    def _continues_to(self, index: int) -> bool:
        """Returns whether decoding on is the best way to a frame: it is near, or no keyframe lies between."""
        near = index - self._next <= NEAR or not self._index.keys[self._next + 1 : index + 1].any()
        return 0 <= self._next <= index and near

    def _keys_before(self, index: int) -> NDArray[np.intp]:
        keys = np.flatnonzero(self._index.keys[: index + 1])[::-1]
        return keys[keys > 0][:SEEKS]

    def _start(self) -> None:
        """Opens the file and decodes from the start, exactly as the index was made."""
        self._stream = VideoStream(self.path)
        self._from_start, self._next = True, 0
        frames = (frame for frame in self._stream.frames() if frame is not None)
        self._decoding: Iterator[tuple[int, Any]] = enumerate(frames)

    def _seek(self, key: int) -> bool:
        if not self._stream.seek(int(self._index.stamps[key])):
            return False
        self._from_start, self._next = False, key
        frames = (frame for frame in self._stream.frames() if frame is not None and frame.pts is not None)
        self._decoding = ((self._place(frame.pts), frame) for frame in frames)
        return True

    def _place(self, stamp: int) -> int:
        """Returns the index of the frame with a timestamp, or −1 if there is none."""
        place = min(int(np.searchsorted(self._sorted, stamp)), len(self) - 1)
        return int(self._order[place]) if self._sorted[place] == stamp else -1

    def _advance(self, index: int) -> Picture | None:
        """Decodes up to a frame. Returns None if the frame does not come, or differs from that of the index."""
        passed: deque[tuple[int, Any]] = deque(maxlen=self._most_passed)
        for place, frame in self._decoding:
            if place == index:
                picture = self._picture(index, frame, certain=self._from_start)
                if picture is None:
                    break
                self._next = index + 1
                self._passed = passed or self._passed
                return picture
            if place > index:
                break
            passed.append((place, frame))
        self._next = -1
        return None

    def _picture(self, index: int, frame: Any, *, certain: bool) -> Picture | None:
        """Returns the picture of a decoded frame, or None if it is not certain and differs from that of the index."""
        plain = self._stream.rgb(frame)
        if not certain and zlib.crc32(plain.data) != self._index.checksums[index]:
            return None
        converted = self._pixels.converted(frame)
        return turned(plain if converted is frame else self._stream.rgb(converted), self.turn)

    def close(self) -> None:
        """Closes the file."""
        self._stream.close()
