"""Cameras whose pictures are of another size than they were calibrated for. Numpy only."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.files import CaptureError
from scas4d_core.captures.images import Size

SizeMismatch = Literal["corner", "centre", "stretch"]
"""How a picture of another shape than calibrated came about: cut (or padded) at the right and the bottom, cut evenly
on opposite sides, or resized by different factors along x and y."""

ROUNDING_PIXELS = 0.5
"""A resized picture has the calibrated shape up to the rounding of its sides to whole pixels."""
MIN_RESIZE = 0.05
"""Nobody resizes pictures by less than this share: a few pixels less are cut off, and cutting is another camera."""
CODEC_BLOCK = 16
"""Video codecs pad both sides to a multiple of this; some calibrations were made with the padding, as 1088 for 1080."""


def adapt_intrinsics(
    intrinsics: NDArray[np.float64],
    calibrated: Size,
    found: Size,
    *,
    camera: str,
    where: str,
    size_mismatch: SizeMismatch | None = None,
) -> tuple[NDArray[np.float64], str | None]:
    """Intrinsics [3, 3] for pictures of another size than a camera was calibrated for, and a remark that says so.

    A picture of the calibrated shape was resized: intrinsics scale with it. One of another shape may have been cut in
    more than one way, and the file does not say in which: it is refused unless `size_mismatch` says.

    Args:
        intrinsics: [3, 3] in pixels, principal point from the upper left corner.
        calibrated: (width, height) for which they hold.
        found: (width, height) of the pictures.
        camera: its name, for messages. where: the picture, for messages.
        size_mismatch: how pictures of another shape came about; None refuses them.

    Returns:
        The intrinsics, and the remark; None where the sizes are the same.

    Raises:
        CaptureError: another shape, and `size_mismatch` does not say how.

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
    if _same_shape(calibrated, found) and abs(ratio.mean() - 1) > MIN_RESIZE:
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


def _same_shape(calibrated: Size, found: Size) -> bool:
    """True where one factor gives both sides, rounded."""
    lowest = max((side - ROUNDING_PIXELS) / of for side, of in zip(found, calibrated, strict=True))
    highest = min((side + ROUNDING_PIXELS) / of for side, of in zip(found, calibrated, strict=True))
    return lowest <= highest
