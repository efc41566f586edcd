"""Adapts camera intrinsics to images that do not have the size assumed by the calibration.

This module requires only NumPy.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.files import CaptureError
from scas4d_core.captures.images import Size

SizeMismatch = Literal["corner", "centre", "stretch"]
"""How images with a different aspect ratio than the calibrated one were produced.

``corner``: cropped (or padded) at the right and bottom. ``centre``: cropped evenly on opposite sides. ``stretch``:
resized by different factors along x and y.
"""

ROUNDING_PIXELS = 0.5
"""Tolerance per side when comparing aspect ratios, because resized sides are rounded to whole pixels."""
MIN_RESIZE = 0.05
"""Minimum relative change of size that counts as resizing; a smaller change is treated as cropping."""
CODEC_BLOCK = 16
"""Video codecs pad width and height to a multiple of this. Some calibrations include the padding, e.g. 1088 for
1080."""


def adapt_intrinsics(
    intrinsics: NDArray[np.float64],
    calibrated: Size,
    found: Size,
    *,
    camera: str,
    where: str,
    size_mismatch: SizeMismatch | None = None,
) -> tuple[NDArray[np.float64], str | None]:
    """Adapts intrinsics to images whose size differs from the calibrated size.

    If the aspect ratio is the same and the size differs by more than ``MIN_RESIZE``, the images
    were resized, and the intrinsics are scaled. Otherwise, the images may have been cropped in
    several ways. The caller must then specify `size_mismatch`.

    Args:
        intrinsics: [3, 3] camera matrix in pixels, with the principal point relative to the upper
            left corner of the image.
        calibrated: (width, height) for which the camera was calibrated.
        found: actual (width, height) of the images.
        camera: name of the camera, used in messages.
        where: path of the image, used in messages.
        size_mismatch: how images were produced that were not merely resized, or None to reject such
            images.

    Returns:
        The adapted intrinsics, and a remark for the user that describes the change. The remark is
        None if the sizes are equal.

    Raises:
        CaptureError: if the images were not merely resized and `size_mismatch` is None.

    >>> k = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    >>> half, remark = adapt_intrinsics(k, (64, 48), (32, 24), camera="c", where="c.png")
    >>> half[0].tolist(), remark
    ([50.0, 0.0, 16.0], "camera 'c': calibrated for 64x48, but images are 32x24; intrinsics scaled by 0.5")
    >>> adapt_intrinsics(k, (64, 48), (60, 48), camera="c", where="c.png", size_mismatch="centre")[0][0].tolist()
    [100.0, 0.0, 30.0]
    """
    if calibrated == found:
        return intrinsics, None
    said = f"camera {camera!r}: calibrated for {calibrated[0]}x{calibrated[1]}, but images are {found[0]}x{found[1]}"
    ratio = np.array([found[0] / calibrated[0], found[1] / calibrated[1]])
    k = intrinsics.copy()
    if _same_aspect_ratio(calibrated, found) and abs(ratio.mean() - 1) > MIN_RESIZE:
        k[:2] *= ratio[:, None]
        return k, f"{said}; intrinsics scaled by {ratio.mean():.4g}"
    if size_mismatch == "stretch":
        k[:2] *= ratio[:, None]
        return k, f"{said}; intrinsics scaled by {ratio[0]:.5g} along x and {ratio[1]:.5g} along y"
    if size_mismatch == "centre":
        k[:2, 2] += (np.array(found) - calibrated) / 2
        return k, f"{said}; treated as cropped evenly on opposite sides"
    if size_mismatch == "corner":
        return k, f"{said}; treated as cropped at the right and bottom"
    padded = all(big == -(-small // CODEC_BLOCK) * CODEC_BLOCK for big, small in zip(calibrated, found, strict=True))
    hint = " (codec padding to a multiple of 16, usually at the right and bottom; try --size-mismatch corner)"
    raise CaptureError(
        f"{where} is {found[0]}x{found[1]} pixels, but camera {camera!r} was calibrated for "
        f"{calibrated[0]}x{calibrated[1]}{hint if padded else ''}; use images of that size, or specify how they "
        "were produced: --size-mismatch corner (cropped at the right and bottom), centre (cropped evenly) or stretch"
    )


def _same_aspect_ratio(calibrated: Size, found: Size) -> bool:
    """Returns whether a single scale factor maps one size to the other, up to rounding."""
    lowest = max((side - ROUNDING_PIXELS) / of for side, of in zip(found, calibrated, strict=True))
    highest = min((side + ROUNDING_PIXELS) / of for side, of in zip(found, calibrated, strict=True))
    return lowest <= highest
