"""Variants of a capture, for example reversed or with fewer cameras.

Test images, masks and ground truth are restricted to the selected frames. A point cloud belongs to the capture's first
frame, so variants that start at another frame have no point cloud.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Rig
from scas4d_core.captures import Capture
from scas4d_core.captures.ground_truth import GroundTruth
from scas4d_core.captures.reader import PictureReader


@dataclass(frozen=True)
class Variant:
    """A transformation of one capture into another.

    Attributes:
        made: function that transforms a capture.
        changes: settings of the variant, such as ``"scene.image_scale=0.5"``.
    """

    made: Callable[[Capture], Capture]
    changes: tuple[str, ...] = ()


class ChosenFrames:
    """Reader of selected frames of another reader in a given order, with times that increase from 0.

    Args:
        reader: reader of all frames.
        frames: the selected frames, in their new order.
    """

    def __init__(self, reader: PictureReader, frames: Sequence[int]) -> None:
        self._reader, self._frames = reader, tuple(frames)

    @property
    def frame_count(self) -> int:
        """Number of selected frames."""
        return len(self._frames)

    def time(self, index: int) -> float | None:
        """Returns the seconds since the first selected frame, or None if the images have no times."""
        first, now = (self._reader.time(self._frames[i]) for i in (0, index))
        return None if first is None or now is None else abs(now - first)

    def image(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Returns the decoded image [H, W, 3] of a camera."""
        return self._reader.image(self._frames[index], camera)

    def has_mask(self, index: int, camera: str) -> bool:
        """Returns whether a camera has a mask in a frame."""
        return self._reader.has_mask(self._frames[index], camera)

    def mask(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Returns the decoded mask [H, W] of a camera."""
        return self._reader.mask(self._frames[index], camera)

    def encoded_image(self, index: int, camera: str) -> bytes:
        """Returns the contents of an image file."""
        return self._reader.encoded_image(self._frames[index], camera)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """Returns the contents of a mask file, or None if there is none."""
        return self._reader.encoded_mask(self._frames[index], camera)


def of_frames(capture: Capture, frames: Sequence[int]) -> Capture:
    """Returns the capture with only the given frames, in the given order, and a frame rate that matches their spacing.

    >>> from scas4d_core.captures import open_capture
    >>> slow = of_frames(open_capture("samples/robot"), [0, 2, 4])
    >>> slow.frame_count, slow.fps, slow.ground_truth.points.shape[0]
    (3, 15.0, 3)
    """
    step = abs(frames[1] - frames[0]) if len(frames) > 1 else 1
    return replace(
        capture,
        pictures=ChosenFrames(capture.pictures, frames),
        fps=capture.fps / step,
        points=capture.points if frames[0] == 0 else None,
        ground_truth=None if capture.ground_truth is None else _truth(capture.ground_truth, frames),
    )


def _truth(truth: GroundTruth, frames: Sequence[int]) -> GroundTruth:
    chosen = np.asarray(frames)
    return replace(
        truth,
        points=truth.points[chosen],
        visible=truth.visible[chosen],
        parts=tuple(replace(p, pose=None if p.pose is None else p.pose[chosen]) for p in truth.parts),
        label_files={name: tuple(files[i] for i in frames) for name, files in truth.label_files.items()},
    )


def backwards(capture: Capture) -> Capture:
    """Returns the capture with the frames in reverse order."""
    return of_frames(capture, range(capture.frame_count)[::-1])


def every_second(capture: Capture) -> Capture:
    """Returns the capture with every second frame, which doubles all motion."""
    return of_frames(capture, range(0, capture.frame_count, 2))


def later(capture: Capture) -> Capture:
    """Returns the capture without the first third of its frames."""
    return of_frames(capture, range(capture.frame_count // 3, capture.frame_count))


def half_cameras(capture: Capture) -> Capture:
    """Returns the capture with every second training camera."""
    return replace(capture, full_rig=Rig(capture.full_rig.cameras[::2]))


VARIANTS: Mapping[str, Variant] = {
    "as it is": Variant(lambda capture: capture),
    "backwards": Variant(backwards),
    "every second": Variant(every_second),
    "half the cameras": Variant(half_cameras),
    "half the pixels": Variant(lambda capture: capture, ("scene.image_scale=0.5",)),
    "later": Variant(later),
}
"""Variants, keyed by their names in tables."""
