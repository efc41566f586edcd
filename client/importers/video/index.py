"""Index of the visible frames of a video, made by decoding the file once and kept in the user's cache folder.

Containers list packets, not frames. Packets may be hidden by an edit list, carry half a frame, or precede the first
keyframe. Their timestamps may be missing or in another order. Decoding from the start is the only reliable way to
count the visible frames.
"""

from __future__ import annotations

import hashlib
import io
import os
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.extras import pyav
from client.importers.video.stream import VideoStream
from scas4d_core.captures import CaptureError

VERSION = 2
"""Version of the cached files. Files of other versions are not found, because their names differ."""
NO_STAMP = np.iinfo(np.int64).min
"""Timestamp of frames that have none."""
DISPLAY_MATRIX = "DISPLAYMATRIX"
FIXED_POINT = 1 << 16


@dataclass(frozen=True, eq=False)
class VideoIndex:
    """Visible frames of a video, in the order in which decoding from the start returns them.

    The index ends before the first frame that is lost, because the decoder does not report how many are lost.

    Attributes:
        stamps: [T] int64 timestamps in units of the stream's time base; `NO_STAMP` if a frame has none.
        seconds: [T] float64 time of each frame, relative to the first.
        rate: nominal frame rate; 0 if unknown.
        checksums: [T] uint32 CRC-32 of each frame as RGB.
        keys: [T] bool, whether decoding may start at the frame.
        damaged: [T] bool, whether the decoder had to conceal missing data.
        width: stored width in pixels, before `turn`.
        height: stored height in pixels, before `turn`.
        grey: whether the pixel format is greyscale.
        spaced: whether `seconds` are computed from `rate`, because the timestamps do not increase.
        interlaced: whether any frame is interlaced.
        transfer: transfer characteristics, as numbered by ITU-T H.273.
        lost: whether a frame after the last one is lost, and the video goes on after it.
        turn: [2, 2] int8 matrix that the metadata apply to pixel positions (x, y); the identity if there is none.
    """

    stamps: NDArray[np.int64]
    seconds: NDArray[np.float64]
    rate: float
    checksums: NDArray[np.uint32]
    keys: NDArray[np.bool_]
    damaged: NDArray[np.bool_]
    width: int
    height: int
    grey: bool
    spaced: bool
    interlaced: bool
    transfer: int
    lost: bool
    turn: NDArray[np.int8]

    def __len__(self) -> int:
        return len(self.stamps)


def video_index(path: Path) -> VideoIndex:
    """Returns the index of a video from the cache. If the cache does not contain it, decodes the video and adds it.

    Raises:
        CaptureError: if the file cannot be read, has no frames, changes its size, or is turned by an angle other than a
            multiple of 90°.
        MissingExtraError: if PyAV is not installed.
    """
    cached = _cached_file(path)
    with suppress(Exception):  # zipfile and NumPy raise different exceptions for missing and damaged files
        stored = np.load(io.BytesIO(cached.read_bytes()))
        return VideoIndex(**{field.name: _plain(stored[field.name]) for field in fields(VideoIndex)})
    index = _decoded_index(path)
    with suppress(OSError):  # without a cache, the index is made again next time
        cached.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=cached.parent) as beside:
            whole = Path(beside) / cached.name
            np.savez(whole, **asdict(index))
            whole.replace(cached)
    return index


def cache_folder() -> Path:
    """Returns the folder of the cached indices: scas4d/videos in the user's cache folder, or the temporary folder."""
    given = os.environ.get("XDG_CACHE_HOME")
    try:
        return Path(given or Path.home() / ".cache") / "scas4d" / "videos"
    except RuntimeError:  # a user without a home folder, as in some containers
        return Path(gettempdir()) / "scas4d" / "videos"


def _cached_file(path: Path) -> Path:
    """Returns the cached file, whose name depends on the video's path, size and time, and on the decoder's version."""
    try:
        state = path.stat()
    except OSError as fault:
        raise CaptureError(f"{path} cannot be read as video: {fault}") from fault
    identity = (VERSION, pyav().library_versions, str(path.resolve()), state.st_size, state.st_mtime_ns)
    return cache_folder() / f"{hashlib.sha256(repr(identity).encode()).hexdigest()[:32]}.npz"


def _plain(array: NDArray[Any]) -> Any:
    return array if array.ndim else array.item()


def _decoded_index(path: Path) -> VideoIndex:
    video = VideoStream(path)
    stamps: list[int] = []
    checksums: list[int] = []
    keys: list[bool] = []
    damaged: list[bool] = []
    failures: list[int] = []
    first: Any = None
    interlaced = False
    try:
        for frame in _readable(video.frames()):
            if frame is None:
                failures.append(len(stamps))
                continue
            first = first or frame
            if (frame.width, frame.height) != (first.width, first.height):
                raise CaptureError(
                    f"{path}: frame {len(stamps)} is {frame.width}x{frame.height} pixels, but the frames before it are "
                    f"{first.width}x{first.height}; a calibration applies to one size: cut the video there"
                )
            stamps.append(NO_STAMP if frame.pts is None else frame.pts)
            checksums.append(zlib.crc32(video.rgb(frame).data))
            keys.append(bool(frame.key_frame))
            damaged.append(bool(frame.is_corrupt))
            interlaced = interlaced or bool(frame.interlaced_frame)
        if not stamps:
            raise CaptureError(f"{path} has no frames that can be decoded")
        # Recordings often begin or end within a frame. Between two frames, a packet that fails is a lost frame.
        count = next((place for place in failures if 0 < place < len(stamps)), len(stamps))
        seconds, spaced, rate = _times(np.array(stamps[:count], np.int64), video.stream)
        return VideoIndex(
            stamps=np.array(stamps[:count], np.int64),
            seconds=seconds,
            rate=rate,
            checksums=np.array(checksums[:count], np.uint32),
            keys=np.array(keys[:count]),
            damaged=np.array(damaged[:count]),
            width=first.width,
            height=first.height,
            grey=first.format.name.startswith("gray"),
            spaced=spaced,
            interlaced=interlaced,
            transfer=int(video.stream.codec_context.color_trc),
            lost=count < len(stamps),
            turn=_turn(first, path),
        )
    finally:
        video.close()


def _readable(frames: Iterator[Any]) -> Iterator[Any]:
    """Yields the frames up to an error in the file, as if the file ended there.

    Raises:
        CaptureError: if there is no frame before the error.
    """
    some = False
    try:
        for frame in frames:
            yield frame
            some = some or frame is not None
    except CaptureError:
        if not some:
            raise


def _times(stamps: NDArray[np.int64], stream: Any) -> tuple[NDArray[np.float64], bool, float]:
    """Returns the time of each frame in seconds, whether they are computed from the frame rate, and the frame rate."""
    rate = float(stream.average_rate or stream.guessed_rate or 0)
    if (stamps != NO_STAMP).all() and (np.diff(stamps) > 0).all():
        return (stamps - stamps[0]) * float(stream.time_base), False, rate
    rate = rate or 25.0  # FFmpeg's default for streams without a rate
    return np.arange(len(stamps)) / rate, True, rate


def _turn(frame: Any, path: Path) -> NDArray[np.int8]:
    """Returns the matrix [2, 2] by which the metadata turn or mirror the picture.

    Raises:
        CaptureError: if the metadata turn it by another angle than a multiple of 90°.
    """
    if DISPLAY_MATRIX not in frame.side_data:
        return np.eye(2, dtype=np.int8)
    # FFmpeg's libavutil/display.h: x' = a·x + c·y, y' = b·x + d·y, stored as a b u, c d v, x y w.
    a, b, _, c, d, *_ = np.frombuffer(frame.side_data[DISPLAY_MATRIX], np.int32)
    turn = np.array([[a, c], [b, d]]) / FIXED_POINT
    if not np.array_equal(np.abs(turn), np.eye(2)) and not np.array_equal(np.abs(turn), np.eye(2)[::-1]):
        raise CaptureError(
            f"{path}: its metadata turn the picture by another angle than a multiple of 90°, or scale it; store the "
            "pixels as calibrated and remove the display matrix"
        )
    return turn.astype(np.int8)
