"""Implementation of `scas4d video`, which renders states along a camera path to an MP4 or an animated WebP."""

from __future__ import annotations

import re
from pathlib import Path

from client.exports.sources import frame_range, opened
from client.exports.video.shot import VideoOptions, plan_shot
from client.exports.video.video_file import check_suffix, video_file
from client.importers.extras import pyav
from client.progress import Bars, console
from scas4d_core.captures import Capture
from scas4d_core.errors import InputError

SMALLEST, LARGEST = 16, 7680
"""Minimum and maximum width and height of the rendered image in pixels. Memory and encoders limit the size."""


def make_video(
    source: str,
    out: Path | None,
    options: VideoOptions,
    *,
    frames: str | None = None,
    compared: Capture | None = None,
    url: str,
    token: str | None,
) -> Path:
    """Renders a video, keeping only two states and one image in memory at a time, and returns its path.

    Args:
        source: source of the states; see `opened`.
        out: path that ends in `.mp4` or `.webp`; None for an MP4 next to the source, named after it.
        options: video options.
        frames: inclusive range `A:B`; None for all frames.
        compared: capture whose ground-truth images from the same camera are shown to the right of the rendered images.
        url: service URL.
        token: access token for the service.

    Raises:
        InputError: if an option is invalid, or frames, a camera or parts do not exist.
        MissingExtraError: if PyAV is not installed.
    """
    low, high = frame_range(frames)
    if out is not None:
        check_suffix(out)
    pyav()  # fail early, before anything is downloaded or compiled
    with opened(source, low, high, options.parts, url, token) as given, Bars() as bars:
        if given.of.damage is not None:
            console.print(f"only part of the source can be read: {given.of.damage}", soft_wrap=True)
        target = out or given.beside / f"{given.name}-{Path(options.path).stem}.mp4"
        planned = plan_shot(given, low, high, options, compared, even=check_suffix(target) == ".mp4")
        _compile_kernels(bars)
        with video_file(target, planned.fps) as add:
            for number, picture in enumerate(planned.pictures()):
                add(picture)
                bars("rendering", number + 1, planned.count)
    width, height = planned.whole_size
    seconds, size = planned.count / planned.fps, target.stat().st_size / 1e6
    summary = f"{planned.count} images of {width}x{height}, {seconds:.1f} s, {size:.1f} MB"
    console.print(f"{target}: {summary}", highlight=False, soft_wrap=True)
    return target


def picture_size(text: str) -> tuple[int, int]:
    """Parses an image size and returns (width, height).

    Raises:
        InputError: if the text is not a size, or the size is not supported.

    >>> picture_size("1280x720")
    (1280, 720)
    """
    match = re.fullmatch(r"(\d{1,5})[xX×](\d{1,5})", text.strip())
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(SMALLEST <= side <= LARGEST for side in size):
        raise InputError(
            f"size {text!r} is not a valid image size",
            f"use WIDTHxHEIGHT, such as 1280x720, with {SMALLEST} to {LARGEST} pixels per side",
        )
    return size


def background_colour(text: str) -> tuple[float, float, float]:
    """Parses a colour name or hex code and returns RGB in [0, 1].

    Raises:
        InputError: if the text is not a colour.

    >>> background_colour("#ff8000"), background_colour("white")
    ((1.0, 0.5019607843137255, 0.0), (1.0, 1.0, 1.0))
    """
    from PIL import ImageColor

    try:
        red, green, blue = ImageColor.getrgb(text)[:3]
    except ValueError:
        raise InputError(
            f"background {text!r} is not a colour", "use a name or #rrggbb, such as white or #202020"
        ) from None
    return red / 255, green / 255, blue / 255


def _compile_kernels(bars: Bars) -> None:
    from scas4d_core.compilation.manifest import KernelGroup
    from scas4d_core.warm_up import compile_in_processes

    compile_in_processes(
        (KernelGroup.FIRST_FRAME,), on_progress=lambda done, total: bars("compiling the kernels", done, total)
    )
