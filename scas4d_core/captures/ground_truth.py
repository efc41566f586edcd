"""Ground truth of a synthetic capture: point tracks, visibility, parts and their labels. Numpy only."""

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
    """One part of the scene.

    Attributes:
        id: the part's value in part labels.
        name: for people.
        rigid: true where all of the part moves as one.
        static: true where it stands still throughout.
        foreground: true where masks cover it.
        pose: [T, 4, 4] part to world, where rigid; a point moves from frame s to t by ``pose[t] @ inv(pose[s])``.
    """

    id: int
    name: str
    rigid: bool
    static: bool
    foreground: bool
    pose: NDArray[np.float64] | None


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Tracks of P material points over T frames, seen by C cameras, and part labels per pixel.

    Attributes:
        points: [T, P, 3] float64 world positions, user's units.
        part_id: [P] int64, the part of each point.
        visible: [T, C, P] bool: inside the picture and not hidden.
        cameras: names for the axis C, training and test cameras alike.
        parts: the table of parts; empty where the capture has none.
        label_files: by camera name, the label picture of every frame; empty where the capture has none.
        image_size: by camera name, (width, height) to which labels are resized.

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
        """[P] bool: points that leave their place of frame 0 by more than a millionth of the box of all points."""
        moved: NDArray[np.float64] = np.linalg.norm(self.points - self.points[:1], axis=-1).max(axis=0)
        box = float(np.ptp(self.points.reshape(-1, 3), axis=0).max())
        moving: NDArray[np.bool_] = moved > 1e-6 * box
        return moving

    def visible_in(self, camera: str) -> NDArray[np.bool_]:
        """[T, P] visibility in one camera.

        Raises:
            KeyError: the ground truth does not know the camera.
        """
        if camera not in self.cameras:
            raise KeyError(camera)
        return self.visible[:, self.cameras.index(camera)]

    @property
    def label_cameras(self) -> tuple[str, ...]:
        """The cameras that have part labels."""
        return tuple(self.label_files)

    def labels(self, camera: str, index: int) -> NDArray[np.uint8]:
        """[H, W] uint8 part id per pixel of a frame, 0 where there is no part; sampled, not averaged, when scaled.

        Raises:
            KeyError: the camera has no labels.
            ImageError: the file cannot be used.
        """
        full, scaled = self.image_size[camera]
        return decode_labels(self.label_files[camera][index], size=full, target=scaled)


def read_ground_truth(folder: Path, frame_count: int, sizes: Mapping[str, tuple[Size, Size]]) -> GroundTruth | None:
    """The ground truth beside a capture: ``gt_tracks.npz``, and if there ``scene.json`` and ``gt_parts/``.

    Args:
        folder: of the capture.
        frame_count: T of the capture.
        sizes: by camera name, full and scaled (width, height).

    Returns:
        None where there is no ``gt_tracks.npz``.

    Raises:
        CaptureError: a file is broken, or does not fit the capture.
    """
    path = folder / "gt_tracks.npz"
    if not path.exists():
        return None
    arrays = read_npz(path, ("points", "part_id", "visible"))
    points, part_id, visible = arrays["points"], arrays["part_id"], arrays["visible"]
    shape = (frame_count, points.shape[1] if points.ndim == 3 else -1, 3)
    if points.shape != shape or not np.isfinite(points).all():
        raise CaptureError(f"{path}: points must be finite [T={frame_count}, P, 3]; found shape {points.shape}")
    if part_id.shape != shape[1:2]:
        raise CaptureError(f"{path}: part_id must be [P={shape[1]}]; found shape {part_id.shape}")
    if visible.ndim != 3 or visible.shape[::2] != shape[:2]:
        raise CaptureError(f"{path}: visible must be [T={frame_count}, C, P={shape[1]}]; found shape {visible.shape}")
    label_files = {}
    for name in sizes:
        files = tuple(folder / "gt_parts" / name / f"{index:06d}.png" for index in range(frame_count))
        if files[0].parent.is_dir():
            missing = next((file for file in files if not file.is_file()), None)
            if missing:
                raise CaptureError(f"{missing}: no such file; label every frame of camera {name} or none")
            label_files[name] = files
    return GroundTruth(
        points=points.astype(np.float64),
        part_id=part_id.astype(np.int64),
        visible=visible.astype(np.bool_),
        # The axis C is indexed by cam_id, which is also the cameras' name.
        cameras=tuple(str(index) for index in range(visible.shape[1])),
        parts=_read_parts(folder / "scene.json", frame_count),
        label_files=label_files,
        image_size=dict(sizes),
    )


def read_extent(folder: Path) -> float | None:
    """Longest side of the box of the foreground over the sequence, user's units, where ``scene.json`` has it."""
    path = folder / "scene.json"
    value = read_json(path).get("extent") if path.exists() else None
    if value is None:
        return None
    if not isinstance(value, int | float) or not (np.isfinite(value) and value > 0):
        raise CaptureError(f"{path}: extent {value!r} must be a positive number")
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
            raise CaptureError(f"{path}: parts[{number}] is not a part ({type(fault).__name__}: {fault})") from fault
        if pose is not None and pose.shape != (frame_count, 4, 4):
            raise CaptureError(f"{path}: parts[{number}].pose must be [T={frame_count}, 4, 4]; found {pose.shape}")
        parts.append(part)
    return tuple(parts)
