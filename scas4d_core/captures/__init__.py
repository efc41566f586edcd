"""Reads captures (cameras, images, masks and ground truth) from disk. Requires only NumPy, Pillow and simplejpeg."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scas4d_core.captures.capture import Capture
from scas4d_core.captures.dynamic3dgs import TRAIN_META, read_dynamic3dgs
from scas4d_core.captures.files import CaptureError
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.captures.ground_truth import GroundTruth, TruePart
from scas4d_core.captures.images import check_image, check_mask, decode_image, decode_mask, resize_area
from scas4d_core.captures.picture_file import ImageError
from scas4d_core.captures.reader import PictureReader
from scas4d_core.captures.size_mismatch import SizeMismatch

__all__ = [
    "Capture",
    "CaptureError",
    "Frame",
    "GroundTruth",
    "ImageError",
    "InitialPoints",
    "PictureReader",
    "SizeMismatch",
    "TruePart",
    "check_image",
    "check_mask",
    "decode_image",
    "decode_mask",
    "open_capture",
    "read_dynamic3dgs",
    "resize_area",
]


def open_capture(folder: Path | str, **options: Any) -> Capture:
    """Opens a capture. The files in the folder determine which layout is read.

    Args:
        folder: folder of the capture.
        options: keyword arguments for `read_dynamic3dgs`: image_scale, fps, use_masks, use_points,
            size_mismatch, bit_depth.

    Raises:
        CaptureError: if the folder does not exist, its layout is unknown, or one of its files is
            missing or invalid.

    >>> capture = open_capture("samples/robot", image_scale=0.25)
    >>> capture.rig.names[:3], capture.frame_count
    (('0', '1', '2'), 14)
    >>> capture.frame(0).images["0"].shape
    (64, 64, 3)
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; check the path")
    if (folder / TRAIN_META).exists():
        return read_dynamic3dgs(folder, **options)
    raise CaptureError(f"{folder}: unknown capture layout; Dynamic3DGaussians captures contain {TRAIN_META}")
