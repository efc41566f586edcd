"""Video files written image by image with PyAV: H.264 in an MP4, or an animated WebP."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from client.importers.extras import pyav
from scas4d_core.errors import InputError

Picture = NDArray[np.uint8]

SUFFIXES = (".mp4", ".webp")
QUALITY = {".mp4": {"crf": "18", "preset": "medium"}, ".webp": {"quality": "90", "lossless": "0"}}
"""Encoder options for visually lossless quality."""
FINEST_RATE = 65535
"""Largest frame-rate denominator that the containers can store."""


def check_suffix(path: Path) -> str:
    """Returns the suffix of a video file in lowercase.

    Raises:
        InputError: if the suffix is not supported.

    >>> check_suffix(Path("a.MP4"))
    '.mp4'
    >>> check_suffix(Path("a.gif"))
    Traceback (most recent call last):
    scas4d_core.errors.InputError: out 'a.gif' has the unsupported suffix '.gif'; use .mp4 or .webp
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"out {str(path)!r} has the unsupported suffix {path.suffix!r}", f"use {' or '.join(SUFFIXES)}"
        )
    return suffix


@contextmanager
def video_file(path: Path, fps: float) -> Iterator[Callable[[Picture], None]]:
    """Opens a video file to which images of equal size can be added.

    Missing folders are created, and the file appears only once it is complete. Images are encoded as they are added and
    are not kept. An MP4 uses 8-bit 4:2:0 subsampling for compatibility, with limited-range BT.709 colours, and is
    tagged accordingly. A WebP loops forever.

    Args:
        path: path that ends in `.mp4` or `.webp`.
        fps: frames per second.

    Yields:
        A function that adds an image [H, W, 3] with sRGB values 0…255. In an MP4, an odd last row or column is cropped,
        because the encoding requires even sizes.

    Raises:
        InputError: if the suffix is not supported, no image was added, or the file cannot be written.
        MissingExtraError: if PyAV is not installed.

    >>> with video_file(out / "grey.mp4", 25) as add:
    ...     for level in range(3):
    ...         add(np.full((16, 32, 3), level, np.uint8))
    """
    from scas4d_core.exports.atomic_files import atomic_path

    suffix, av = check_suffix(path), pyav()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as beside:
        encoder: _Encoder | None = None
        try:
            encoder = _Encoder(beside, suffix, fps)
            yield encoder.add
            if not encoder.count:
                raise InputError(f"out {str(path)!r} would contain no images", "choose frames that exist")
            encoder.finish()
        except av.FFmpegError as error:
            remedy = "use a smaller size, or another --fps"
            raise InputError(f"out {str(path)!r} cannot be encoded at {fps:g} fps ({error})", remedy) from error
        finally:
            if encoder is not None:
                encoder.close()


class _Encoder:
    """Encoder for one video file.

    Attributes:
        count: number of images added so far.
    """

    def __init__(self, path: Path, suffix: str, fps: float) -> None:
        self._av = pyav()
        self._mp4 = suffix == ".mp4"
        self._rate = Fraction(fps).limit_denominator(FINEST_RATE)
        self.count = 0
        options = {"movflags": "faststart"} if self._mp4 else {"loop": "0"}
        self._container = self._av.open(str(path), "w", format=suffix[1:], options=options)
        self._stream = self._container.add_stream("libx264" if self._mp4 else "libwebp_anim", rate=self._rate)
        self._stream.options = QUALITY[suffix]
        if self._mp4:
            context = self._stream.codec_context
            context.color_range, context.colorspace = 1, 1  # limited; BT.709
            context.color_primaries, context.color_trc = 1, 1

    def add(self, picture: Picture) -> None:
        height, width = picture.shape[:2]
        if self._mp4:
            height, width = height // 2 * 2, width // 2 * 2
        if not self.count:
            self._stream.width, self._stream.height = width, height
            self._stream.pix_fmt = "yuv420p" if self._mp4 else "bgra"
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), "rgb24")
        if self._mp4:
            frame = frame.reformat(
                format="yuv420p",
                src_colorspace="ITU709", dst_colorspace="ITU709", src_color_range="JPEG", dst_color_range="MPEG",
            )  # fmt: skip
        else:
            frame = frame.reformat(format="bgra")
        frame.pts, frame.time_base = self.count, 1 / self._rate
        self._container.mux(self._stream.encode(frame))
        self.count += 1

    def finish(self) -> None:
        """Flushes the encoder."""
        self._container.mux(self._stream.encode(None))

    def close(self) -> None:
        self._container.close()
