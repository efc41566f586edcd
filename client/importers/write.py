"""Writes a capture in the Dynamic3DGaussians layout, which every command reads without optional packages."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from client.left_out import LeftOut
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Capture, CaptureError, ImageError

OnProgress = Callable[[str, int, int], None]

UNEVEN = 0.1
"""Maximum deviation from a constant frame rate, in frames. It allows for rounded video timestamps."""


def write_dynamic3dgs(
    source: Capture,
    out: Path,
    *,
    frames: int | None = None,
    on_progress: OnProgress | None = None,
    on_message: Callable[[str], None] | None = None,
) -> LeftOut:
    """Writes a capture in the Dynamic3DGaussians layout.

    Images are written to `ims/`, masks to `seg/`, points to `init_pt_cld.npz`, and cameras to `train_meta.json` and
    `test_meta.json`. The camera files are written last, so an incomplete folder is not recognized as a capture. Images
    that cannot be used are not written, and commands that read the folder go on without them.

    Args:
        source: capture to write; its test cameras are written to `test_meta.json`.
        out: output folder, new or empty.
        frames: number of frames; None for all.
        on_progress: callback that receives ("frames", done, total).
        on_message: callback that receives a message for each image that cannot be used.

    Returns:
        A record of the images that cannot be used.

    Raises:
        CaptureError: if the folder is not empty, or the frames are not evenly spaced in time.

    >>> from client.importers.open_source import open_source
    >>> write_dynamic3dgs(open_source(folder, test=("1",)), out, frames=2).images
    0
    >>> sorted(path.name for path in out.iterdir())
    ['ims', 'init_pt_cld.npz', 'seg', 'test_meta.json', 'train_meta.json']
    """
    if out.exists() and any(out.iterdir()):
        raise CaptureError(f"{out} is not empty; choose a new folder")
    held_out = () if source.full_test_rig is None else source.full_test_rig.cameras
    cameras = [*source.full_rig.cameras, *held_out]
    count = min(frames or source.frame_count, source.frame_count)
    ends: dict[tuple[str, int], str] = {}
    fps = _rate(source, count)

    left_out = LeftOut(Rig(tuple(cameras)), minimum=1)

    def write(index: int, name: str) -> str | None:
        """Writes the files of a camera, or returns why they cannot be used."""
        try:
            picture, mask = source.encoded_image(index, name), source.encoded_mask(index, name)
        except (ImageError, CaptureError) as fault:
            ends[name, index] = ".png"  # there is no file
            return str(fault)
        ends[name, index] = end = _end_of(picture)
        _put(out / "ims" / name / f"{index:06d}{end}", picture)
        if mask is not None:
            _put(out / "seg" / name / f"{index:06d}.png", mask)
        return None

    names = [camera.name for camera in cameras]
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        for index in range(count):
            faults = zip(names, pool.map(write, [index] * len(names), names), strict=True)
            for message in left_out.record(index, {name: fault for name, fault in faults if fault is not None}):
                if on_message is not None:
                    on_message(message)
            if on_progress is not None:
                on_progress("frames", index + 1, count)
    points = source.points
    if points is not None:
        foreground = () if points.foreground is None else (points.foreground[:, None],)
        np.savez(out / "init_pt_cld.npz", data=np.concatenate([points.positions, points.colours, *foreground], axis=1))
    if held_out:
        _write_meta(out / "test_meta.json", held_out, count, ends, fps)
    _write_meta(out / "train_meta.json", source.full_rig.cameras, count, ends, fps)
    return left_out


def _rate(source: Capture, count: int) -> float:
    """Returns the frame rate, which the layout stores instead of individual times.

    Raises:
        CaptureError: if the frames are not evenly spaced in time.
    """
    times = np.array([source.time(index) for index in range(count)])
    if count < 2:
        return source.fps
    fps = float((count - 1) / (times[-1] - times[0]))
    off = np.abs(times - times[0] - np.arange(count) / fps) * fps
    if off.max() > UNEVEN:
        raise CaptureError(
            f"{source.name}: frame {int(off.argmax())} is {off.max():.2g} frames off a constant rate of {fps:.5g} "
            "per second, and this layout stores no times; skip the import, because every command can read the original "
            "capture"
        )
    return fps


def _write_meta(
    path: Path, cameras: Sequence[Camera], count: int, ends: dict[tuple[str, int], str], fps: float
) -> None:
    meta: dict[str, Any] = {
        "w": _one_or_all([camera.width for camera in cameras]),
        "h": _one_or_all([camera.height for camera in cameras]),
        "fps": fps,
        "k": [[camera.intrinsics.tolist() for camera in cameras]] * count,
        "w2c": [[camera.world_to_camera.tolist() for camera in cameras]] * count,
        "cam_id": [[camera.name for camera in cameras]] * count,
        "fn": [[f"{camera.name}/{t:06d}{ends[camera.name, t]}" for camera in cameras] for t in range(count)],
    }
    path.write_text(json.dumps(meta))


def _one_or_all(sizes: list[int]) -> int | list[int]:
    """Returns the image size shared by all cameras, or a list of one size per camera, which extends the layout."""
    return sizes[0] if len(set(sizes)) == 1 else sizes


def _end_of(picture: bytes) -> str:
    if picture.startswith(b"\xff\xd8"):
        return ".jpg"
    return ".png" if picture.startswith(b"\x89PNG") else ".webp"


def _put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.write_bytes(data)
    except OSError as fault:  # a full disk, for which Python does not name the file
        raise OSError(fault.errno, fault.strerror, str(path)) from fault
