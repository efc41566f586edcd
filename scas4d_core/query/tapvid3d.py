"""Converts tracks to the npz format of TAPVid-3D, whose tools can read them as predictions.

Names and axes follow the benchmark's evaluation (google-deepmind/tapnet, ``tapvid3d/evaluation/evaluate_model.py``).
Points are in metres, in the axes of one camera (OpenCV: x right, y down, z forward).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera


def tapvid3d(
    positions: NDArray[Any],
    visibility: NDArray[np.bool_],
    camera: Camera,
    queried: int,
    *,
    metres_per_unit: float = 1.0,
    pixels: NDArray[Any] | None = None,
) -> dict[str, NDArray[Any]]:
    """Returns the arrays of one TAPVid-3D file, keyed by name.

    Images (``images_jpeg_bytes``) are omitted, because predictions do not need them.

    Args:
        positions: [T, Q, 3] positions in the user's world and units, NaN if unknown.
        visibility: [T, Q] bool visibility in the camera.
        camera: camera in the user's world.
        queried: index in T of the frame in which the points were queried, or −1 if that frame is not included.
        metres_per_unit: metres per user unit.
        pixels: [Q, 2] queried pixels, or None for the projections of the points in the queried frame.

    Returns:
        A dict with five arrays:

        - ``tracks_XYZ``: [T, Q, 3] float32 positions in metres, in camera axes.
        - ``visibility``: [T, Q] bool visibility, as given.
        - ``queries_xyt``: [Q, 3] float32 u, v and index in T. Pixel centres are at +0.5, and unknown u and v are NaN.
        - ``fx_fy_cx_cy``: [4] float32 intrinsics in pixels.
        - ``extrinsics_w2c``: [T, 4, 4] float32 transforms from the user's world, in metres, to the camera.

    Raises:
        ValueError: if the shapes do not match.

    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> arrays = tapvid3d(np.array([[[0, 0, 2.0]]]), np.array([[True]]), camera, queried=0)
    >>> arrays["tracks_XYZ"].shape, arrays["queries_xyt"]
    ((1, 1, 3), array([[32., 24.,  0.]], dtype=float32))
    """
    if positions.ndim != 3 or visibility.shape != positions.shape[:2]:
        raise ValueError(
            f"positions must have shape [T, Q, 3], and visibility [T, Q]; got {positions.shape} and {visibility.shape}"
        )
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    count = positions.shape[1]
    if pixels is None:
        pixels = camera.project(positions[queried])[0] if queried >= 0 else np.full((count, 2), np.nan)
    extrinsics = np.eye(4)
    extrinsics[:3, :3], extrinsics[:3, 3] = turn, shift * metres_per_unit
    return {
        "tracks_XYZ": ((positions @ turn.T + shift) * metres_per_unit).astype(np.float32),
        "visibility": visibility,
        "queries_xyt": np.concatenate([pixels, np.full((count, 1), queried)], axis=1).astype(np.float32),
        "fx_fy_cx_cy": np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float32),
        "extrinsics_w2c": np.repeat(extrinsics[None], len(positions), axis=0).astype(np.float32),
    }
