"""Adapts cameras whose images have another size than calibrated. Needs only numpy."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.files import CaptureError
from scas4d_core.captures.images import Size

SizeMismatch = Literal["corner", "centre", "stretch"]
"""How images with another aspect ratio than calibrated were produced.

``corner``: cropped (or padded) at the right and bottom. ``centre``: cropped evenly on opposite sides. ``stretch``:
resized by different factors along x and y.
"""

ROUNDING_PIXELS = 0.5
"""Tolerance per side when comparing aspect ratios, because resized sides are rounded to whole pixels."""
MIN_RESIZE = 0.05
"""Smallest relative size change that counts as resizing; a smaller change is cropping, which shifts the camera."""
CODEC_BLOCK = 16
"""Video codecs pad both sides to a multiple of this. Some calibrations include the padding, such as 1088 for 1080."""


def adapt_intrinsics(
    intrinsics: NDArray[np.float64],
    calibrated: Size,
    found: Size,
    *,
    camera: str,
    where: str,
    size_mismatch: SizeMismatch | None = None,
) -> tuple[NDArray[np.float64], str | None]:
    """Adapts intrinsics [3, 3] to images of another size than calibrated, and returns a remark about it.

    Images with the calibrated aspect ratio were resized, so the intrinsics are scaled. Images with another aspect ratio
    may have been cropped in several ways, so they are rejected unless `size_mismatch` is given.

    Args:
        intrinsics: [3, 3] in pixels, with the principal point relative to the upper left corner.
        calibrated: (width, height) that the intrinsics were calibrated for.
        found: (width, height) of the images.
        camera: name of the camera, for messages.
        where: path of the image, for messages.
        size_mismatch: how images with another aspect ratio were produced; None rejects them.

    Returns:
        The intrinsics and the remark, which is None if the sizes are equal.

    Raises:
        CaptureError: the aspect ratios differ and `size_mismatch` is None.

    >>> k = np.array([[100.0, 0, 32], [0, 100, 24], [0, 0, 1]])
    >>> half, remark = adapt_intrinsics(k, (64, 48), (32, 24), camera="c", where="c.png")
    >>> half[0].tolist(), remark
    ([50.0, 0.0, 16.0], "camera 'c': calibrated for 64x48, its pictures are 32x24: its intrinsics are scaled by 0.5")
    >>> adapt_intrinsics(k, (64, 48), (60, 48), camera="c", where="c.png", size_mismatch="centre")[0][0].tolist()
    [100.0, 0.0, 30.0]
    """
    if calibrated == found:
        return intrinsics, None
    said = f"camera {camera!r}: calibrated for {calibrated[0]}x{calibrated[1]}, its pictures are {found[0]}x{found[1]}"
    ratio = np.array([found[0] / calibrated[0], found[1] / calibrated[1]])
    k = intrinsics.copy()
    if _same_aspect_ratio(calibrated, found) and abs(ratio.mean() - 1) > MIN_RESIZE:
        k[:2] *= ratio[:, None]
        return k, f"{said}: its intrinsics are scaled by {ratio.mean():.4g}"
    if size_mismatch == "stretch":
        k[:2] *= ratio[:, None]
        return k, f"{said}: its intrinsics are stretched by {ratio[0]:.5g} along x and {ratio[1]:.5g} along y"
    if size_mismatch == "centre":
        k[:2, 2] += (np.array(found) - calibrated) / 2
        return k, f"{said}: taken as cut evenly on opposite sides"
    if size_mismatch == "corner":
        return k, f"{said}: taken as cut at the right and the bottom"
    padded = all(big == -(-small // CODEC_BLOCK) * CODEC_BLOCK for big, small in zip(calibrated, found, strict=True))
    hint = " (a codec's padding to a multiple of 16, usually at the right and the bottom: --size-mismatch corner)"
    raise CaptureError(
        f"{where}: is {found[0]}x{found[1]} pixels, but camera {camera!r} was calibrated for "
        f"{calibrated[0]}x{calibrated[1]}{hint if padded else ''}; give the pictures at that size, or say how they "
        "came about: --size-mismatch corner (cut at the right and the bottom), centre (cut evenly) or stretch (resized)"
    )


def _same_aspect_ratio(calibrated: Size, found: Size) -> bool:
    """Returns whether one scale factor maps both sides, up to rounding."""
    lowest = max((side - ROUNDING_PIXELS) / of for side, of in zip(found, calibrated, strict=True))
    highest = min((side + ROUNDING_PIXELS) / of for side, of in zip(found, calibrated, strict=True))
    return lowest <= highest
