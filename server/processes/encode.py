"""Rendered arrays to the bytes of an answer."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from client.wire import part_colour

if TYPE_CHECKING:
    from scas4d_core.query.committed import View

NPZ = "application/vnd.numpy.npz"
FLOAT32 = "application/octet-stream"
QUALITY = 92
"""Of JPEG and WebP where not asked for."""
CHANNELS = {"colour": ("red", "green", "blue"), "depth": ("depth",), "alpha": ("alpha",), "parts": ("parts",)}


def npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays as npz without pickle."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def float32(arrays: Mapping[str, NDArray[Any]]) -> tuple[bytes, dict[str, str]]:
    """Arrays [H, W] or [H, W, 3] by kind, one behind the other in the last axis, as little-endian float32; and headers.

    X-Shape is "H,W,C", X-Channels names the C channels, X-Dtype is "<f4". Rows from the top, C fastest.
    """
    names = [channel for kind in arrays for channel in CHANNELS[kind]]
    stack = np.concatenate([array[..., None] if array.ndim == 2 else array for array in arrays.values()], axis=-1)
    body = np.ascontiguousarray(stack, "<f4")
    headers = {"X-Shape": ",".join(map(str, body.shape)), "X-Channels": ",".join(names), "X-Dtype": "<f4"}
    return body.tobytes(), headers


def view(
    view: View, kinds: Sequence[str], format: str, quality: int | None = None
) -> tuple[bytes, str, dict[str, str]]:
    """A view as body, media type and headers; a picture holds one kind (the door sees to it).

    Args:
        view: what was rendered. kinds: of it.
        format: png, jpeg, webp, npz or float32.
        quality: 1…100, of JPEG and WebP.
    """
    arrays: dict[str, Any] = {kind: getattr(view, kind) for kind in kinds}
    if format == "npz":
        return npz(arrays), NPZ, {}
    if format == "float32":
        body, headers = float32(arrays)
        return body, FLOAT32, headers
    picture, headers = _picture(kinds[0], arrays[kinds[0]])
    file = io.BytesIO()
    if format == "jpeg":
        picture.save(file, "JPEG", quality=quality or QUALITY, subsampling=0)
    elif format == "webp":
        # A live view: fast rather than small (method 0 takes a third of the time of the default).
        picture.save(file, "WEBP", quality=quality or QUALITY, method=0)
    else:
        picture.save(file, "PNG", compress_level=1)
    return file.getvalue(), f"image/{format}", headers


def part_colours() -> list[int]:
    """A palette, 256 × RGB: 0 black, then the colour of each label."""
    return [0, 0, 0, *(channel for label in range(255) for channel in part_colour(label))]


_PART_COLOURS = part_colours()


def _picture(kind: str, array: NDArray[Any]) -> tuple[Image.Image, dict[str, str]]:
    if kind == "depth":
        met = np.isfinite(array)
        near, far = (float(array[met].min()), float(array[met].max())) if met.any() else (0.0, 0.0)
        steps = 1 + np.rint(65534 * (np.where(met, array, near) - near) / max(far - near, 1e-12))
        levels = np.where(met, steps, 0).astype(np.uint16)
        return Image.fromarray(levels), {"X-Depth-Near": repr(near), "X-Depth-Far": repr(far)}
    if kind == "parts":
        labels = Image.fromarray(array)  # pixels are the labels, and a browser shows their colours
        labels.putpalette(_PART_COLOURS)
        return labels, {}
    return Image.fromarray(np.rint(255 * np.clip(array, 0, 1)).astype(np.uint8)), {}
