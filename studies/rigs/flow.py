"""Comparison of tracks with optical flow, for captures without ground truth.

Corners of frame 0 are followed in each camera independently, and as tracks of the scene. The optical flow is computed
with the Lucas–Kanade method. A corner is kept only if following it backwards leads to its start. A correct track stays
on its corner. If a second camera sees the same point, its own corner stays on the epipolar line of the first camera's
corner.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from client.cli.scores import Row
from scas4d_core.cameras import Camera
from scas4d_core.captures import Capture
from scas4d_core.first_frame.points.triangulation import fundamental_matrix
from scas4d_core.reconstruction import Reconstruction

Float = NDArray[np.float64]
Grey = Sequence[NDArray[np.uint8]]

CORNERS, APART = 400, 4
"""Maximum number of corners per image, and minimum distance between them in pixels."""
MOVING = 2.0
"""Minimum motion of a corner from frame 0 to the last frame, in pixels. Static corners reveal nothing about tracks."""
BACK = 0.5
"""Largest error in pixels when a corner is followed back to the previous frame."""
SAME = 0.01
"""Points seen by two cameras count as the same if their distance is below this fraction of the depth."""
FEWEST = 20
"""Minimum number of positions, over points and frames, for computing a median."""


def flow_consistency(scene: Reconstruction, capture: Capture, count: int) -> Row:
    """Compares the tracks of a scene with optical flow at moving corners, within each camera and between cameras.

    Args:
        scene: scene with ``count`` committed frames.
        capture: capture at the rendered resolution, whose training cameras are used.
        count: number of frames.

    Returns:
        ``flow_px`` and ``epipolar_px`` in image pixels of ``capture``, and ``flow_points``. A distance in pixels is
        None if there are too few positions or most are lost.
    """
    rig, indices = capture.rig, list(range(count))
    films: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in rig.names}
    for index in indices:
        for name, image in capture.frame(index).images.items():
            if name in films:
                films[name].append(cv2.cvtColor(np.asarray(image), cv2.COLOR_RGB2GRAY).astype(np.uint8))
    away, beside, points = list[Float](), list[Float](), 0
    cameras = [camera for camera in rig.cameras if len(films[camera.name]) == count]
    for camera in cameras:
        flow = _corners(films[camera.name])
        if not flow.shape[1]:
            continue
        tracks = scene.tracks_of_pixels(camera, flow[0], 0, indices)
        known = np.isfinite(tracks.positions[0]).all(axis=1)
        flow, positions = flow[:, known], tracks.positions[:, known]
        points += int(known.sum())
        off = np.linalg.norm(camera.project(positions)[0] - flow, axis=-1)[1:]
        away.append(np.where(np.isfinite(off), off, np.inf).ravel())
        for other in cameras:
            if other is not camera:
                beside.append(_from_lines(scene, (camera, other), positions[0], flow, films[other.name]))
    return {
        "flow_px": _median(away),
        "epipolar_px": _median(beside),
        "flow_points": points,
    }


def followed(film: Grey, start: Float) -> Float:
    """Tracks points through the images of a camera and returns [T, Q, 2] pixels, NaN after a point is lost.

    Args:
        film: T grey images [H, W].
        start: [Q, 2] pixels in the first image, where the centre of the first pixel is at 0.5.
    """
    paths = np.full((len(film), len(start), 2), np.nan)
    paths[0] = start
    for index in range(1, len(film)):
        here = (paths[index - 1] - 0.5).astype(np.float32)
        there = np.isfinite(here).all(axis=1)
        if not there.any():
            break
        ahead, seen = _flow(film[index - 1], film[index], here[there])
        back, seen_back = _flow(film[index], film[index - 1], ahead)
        good = seen & seen_back & (np.linalg.norm(back - here[there], axis=1) < BACK)
        paths[index, np.flatnonzero(there)[good]] = ahead[good] + 0.5
    return paths


def _flow(
    picture: NDArray[np.uint8], after: NDArray[np.uint8], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Returns the positions [Q, 2] of points in the next image, and a mask [Q] of the points that were found."""
    where, status, _ = cv2.calcOpticalFlowPyrLK(picture, after, points, points.copy())
    return np.asarray(where, np.float32), np.asarray(status).ravel() > 0


def _corners(film: Grey) -> Float:
    """Returns [T, Q, 2] corners of the first image that move and can be tracked to the last image."""
    start = np.asarray(cv2.goodFeaturesToTrack(film[0], CORNERS, 0.01, APART), np.float64)  # None becomes NaN
    paths = followed(film, start.reshape(-1, 2) + 0.5 if start.ndim else np.zeros((0, 2)))
    moves = np.linalg.norm(paths[-1] - paths[0], axis=1) >= MOVING  # False for NaN
    return paths[:, moves]


def _from_lines(scene: Reconstruction, pair: tuple[Camera, Camera], points: Float, flow: Float, film: Grey) -> Float:
    """Returns the pixel distances of a second camera's corners from the first one's epipolar lines, in all frames.

    Args:
        scene: the reconstructed scene.
        pair: first and second camera.
        points: [Q, 3] points in frame 0.
        flow: [T, Q, 2] pixels in the first camera.
        film: images of the second camera.
    """
    first, second = pair
    uv, depth = second.project(points)
    inside = (depth > 0) & (uv >= 0).all(axis=1) & (uv < (second.width, second.height)).all(axis=1)
    if not inside.any():
        return np.zeros(0)
    shown = scene.tracks_of_pixels(second, uv[inside], 0, [0]).positions[0]
    near = np.linalg.norm(shown - points[inside], axis=1) < SAME * depth[inside]  # False for NaN, where nothing is hit
    rows = np.flatnonzero(inside)[near]
    other = followed(film, uv[rows])[1:]
    ones = np.ones((*flow.shape[:2], 1))[1:, rows]
    lines = np.concatenate([flow[1:, rows], ones], axis=-1) @ fundamental_matrix(first, second).T
    distance = np.abs((np.concatenate([other, ones], axis=-1) * lines).sum(-1)) / np.linalg.norm(
        lines[..., :2], axis=-1
    )
    distances: Float = distance[np.isfinite(distance)]
    return distances


def _median(parts: Sequence[Float]) -> float | None:
    values = np.concatenate(parts) if parts else np.zeros(0)
    median = float(np.median(values)) if len(values) >= FEWEST else np.inf
    return median if np.isfinite(median) else None
