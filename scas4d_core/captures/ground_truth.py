"""Ground truth of a synthetic capture: point tracks, visibility, parts and part labels. Requires only NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scas4d_core.captures.files import CaptureError, read_json, read_npz
from scas4d_core.captures.images import Size, decode_labels


@dataclass(frozen=True, eq=False)
class TruePart:
    """Ground truth of one part of the scene.

    Attributes:
        id: pixel value of the part in label images.
        name: human-readable name.
        rigid: whether the part moves as a rigid body.
        static: whether the part never moves.
        foreground: whether the masks include the part.
        pose: [T, 4, 4] part-to-world transforms if the part is rigid, otherwise None.
            ``pose[t] @ inv(pose[s])`` moves a point of the part from frame s to frame t.
    """

    id: int
    name: str
    rigid: bool
    static: bool
    foreground: bool
    pose: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Ground truth of a capture: point tracks, their visibility in each camera, and part labels.

    P is the number of tracked material points, T the number of frames, and C the number of cameras.

    Attributes:
        points: [T, P, 3] float64 world positions, in the user's units.
        part_id: [P] int64 part id of each point.
        visible: [T, C, P] bool, whether each point is inside the image and not occluded.
        cameras: names of the C cameras, which include training and test cameras.
        parts: parts of the scene; empty if the capture lists none.
        label_files: maps each camera name to the paths of its label images, one per frame; empty if there are none.
        image_size: maps each camera name to its full and scaled (width, height). Labels are resized
            from the full to the scaled size.

    >>> from scas4d_core.captures import open_capture
    >>> truth = open_capture("samples/robot").ground_truth
    >>> truth.points.shape, truth.visible_in("0").shape, int(truth.moving.sum())
    ((14, 512, 3), (14, 512), 325)
    >>> [part.name for part in truth.parts][:3]
    ['base', 'turret', 'upper_arm']
    """

    points: NDArray[np.float64]
    part_id: NDArray[np.int64]
    visible: NDArray[np.bool_]
    cameras: tuple[str, ...]
    parts: tuple[TruePart, ...]
    label_files: Mapping[str, tuple[Path, ...]]
    image_size: Mapping[str, tuple[Size, Size]]

    @property
    def moving(self) -> NDArray[np.bool_]:
        """[P] bool, whether each point ever leaves its position in frame 0.

        A displacement of up to 10⁻⁶ times the longest side of the bounding box does not count as
        motion. The box contains all points of all frames.
        """
        moved: NDArray[np.float64] = np.linalg.norm(self.points - self.points[:1], axis=-1).max(axis=0)
        box = float(np.ptp(self.points.reshape(-1, 3), axis=0).max())
        moving: NDArray[np.bool_] = moved > 1e-6 * box
        return moving

    def visible_in(self, camera: str) -> NDArray[np.bool_]:
        """Returns the visibility [T, P] in one camera.

        Raises:
            KeyError: if the ground truth does not include the camera.
        """
        if camera not in self.cameras:
            raise KeyError(camera)
        return self.visible[:, self.cameras.index(camera)]

    @property
    def label_cameras(self) -> tuple[str, ...]:
        """Cameras that have part labels."""
        return tuple(self.label_files)

    def labels(self, camera: str, index: int) -> NDArray[np.uint8]:
        """Returns the part id of each pixel in a frame, [H, W] uint8; 0 where there is no part.

        Labels are resized by sampling, because the average of two ids is meaningless.

        Raises:
            KeyError: if the camera has no labels.
            ImageError: if the label image is invalid.
        """
        full, scaled = self.image_size[camera]
        return decode_labels(self.label_files[camera][index], size=full, target=scaled)


def read_ground_truth(folder: Path, frame_count: int, sizes: Mapping[str, tuple[Size, Size]]) -> GroundTruth | None:
    """Reads the ground truth of a capture.

    The ground truth consists of ``gt_tracks.npz`` and, if they exist, ``scene.json`` and
    ``gt_parts/``.

    Args:
        folder: capture folder.
        frame_count: number of frames in the capture, T.
        sizes: maps each camera name to its full and scaled (width, height).

    Returns:
        The ground truth, or None if ``gt_tracks.npz`` does not exist.

    Raises:
        CaptureError: if a file is damaged or does not match the capture.
    """
    path = folder / "gt_tracks.npz"
    if not path.exists():
        return None
    arrays = read_npz(path, ("points", "part_id", "visible"))
    points, part_id, visible = arrays["points"], arrays["part_id"], arrays["visible"]
    shape = (frame_count, points.shape[1] if points.ndim == 3 else -1, 3)
    if points.shape != shape or not np.isfinite(points).all():
        raise CaptureError(
            f"{path}: points must be finite with shape [T={frame_count}, P, 3]; got shape {points.shape}"
        )
    if part_id.shape != shape[1:2]:
        raise CaptureError(f"{path}: part_id must have shape [P={shape[1]}]; got {part_id.shape}")
    if visible.ndim != 3 or visible.shape[::2] != shape[:2]:
        raise CaptureError(f"{path}: visible must have shape [T={frame_count}, C, P={shape[1]}]; got {visible.shape}")
    label_files = {}
    for name in sizes:
        files = tuple(folder / "gt_parts" / name / f"{index:06d}.png" for index in range(frame_count))
        if files[0].parent.is_dir():
            missing = next((file for file in files if not file.is_file()), None)
            if missing:
                raise CaptureError(f"{missing}: no such file; label all frames of camera {name}, or none")
            label_files[name] = files
    return GroundTruth(
        points=points.astype(np.float64),
        part_id=part_id.astype(np.int64),
        visible=visible.astype(np.bool_),
        # The camera axis C is indexed by cam_id, which is also the name of the camera.
        cameras=tuple(str(index) for index in range(visible.shape[1])),
        parts=_read_parts(folder / "scene.json", frame_count),
        label_files=label_files,
        image_size=dict(sizes),
    )


def read_extent(folder: Path) -> float | None:
    """Reads the longest side of the foreground's bounding box over all frames, in the user's units.

    Returns:
        The value of ``extent`` in ``scene.json``, or None if the file or the value is missing.

    Raises:
        CaptureError: if the file is invalid, or the value is not a positive number.
    """
    path = folder / "scene.json"
    value = read_json(path).get("extent") if path.exists() else None
    if value is None:
        return None
    if not isinstance(value, int | float) or not (np.isfinite(value) and value > 0):
        raise CaptureError(f"{path}: extent must be a positive number; got {value!r}")
    return float(value)


def _read_parts(path: Path, frame_count: int) -> tuple[TruePart, ...]:
    if not path.exists():
        return ()
    parts = []
    for number, entry in enumerate(read_json(path).get("parts", [])):
        try:
            pose = None if entry.get("pose") is None else np.array(entry["pose"], dtype=np.float64)
            part = TruePart(
                id=int(entry["id"]),
                name=str(entry["name"]),
                rigid=bool(entry["rigid"]),
                static=bool(entry["static"]),
                foreground=bool(entry["foreground"]),
                pose=pose,
            )
        except (KeyError, TypeError, ValueError, AttributeError) as fault:
            raise CaptureError(
                f"{path}: parts[{number}] is not a valid part ({type(fault).__name__}: {fault})"
            ) from fault
        if pose is not None and pose.shape != (frame_count, 4, 4):
            raise CaptureError(
                f"{path}: parts[{number}].pose must have shape [T={frame_count}, 4, 4]; got {pose.shape}"
            )
        parts.append(part)
    return tuple(parts)
