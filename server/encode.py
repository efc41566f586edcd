"""Rendered arrays to the bytes of an answer."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

if TYPE_CHECKING:
    from scas4d_core.committed import View

NPZ = "application/vnd.numpy.npz"
JPEG_QUALITY = 92


def npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as npz without pickle."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def view(view: View, kinds: Sequence[str], format: str) -> tuple[bytes, str, dict[str, str]]:
    """A view as body, media type and headers; formats other than npz take one kind (the door sees to it)."""
    arrays: dict[str, Any] = {kind: getattr(view, kind) for kind in kinds}
    if format == "npz":
        return npz(arrays), NPZ, {}
    picture, headers = _picture(kinds[0], arrays[kinds[0]])
    file = io.BytesIO()
    if format == "jpeg":
        picture.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    else:
        picture.save(file, "PNG", compress_level=1)  # a live view: fast rather than small
    return file.getvalue(), f"image/{format}", headers


def _picture(kind: str, array: NDArray[Any]) -> tuple[Image.Image, dict[str, str]]:
    if kind == "depth":
        met = np.isfinite(array)
        near, far = (float(array[met].min()), float(array[met].max())) if met.any() else (0.0, 0.0)
        steps = 1 + np.rint(65534 * (np.where(met, array, near) - near) / max(far - near, 1e-12))
        levels = np.where(met, steps, 0).astype(np.uint16)
        return Image.fromarray(levels), {"X-Depth-Near": repr(near), "X-Depth-Far": repr(far)}
    if kind == "parts":
        return Image.fromarray(array), {}
    return Image.fromarray(np.rint(255 * np.clip(array, 0, 1)).astype(np.uint8)), {}
