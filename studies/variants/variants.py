"""The variants of a capture: its test cameras, masks, truth and points are those of the frames that are left.

A cloud is of the capture's first frame: a variant that begins elsewhere has none.
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
    """A way to make another capture of one.

    Attributes:
        made: the other capture. changes: settings that it has, as ``"scene.image_scale=0.5"``.
    """

    made: Callable[[Capture], Capture]
    changes: tuple[str, ...] = ()


class ChosenFrames:
    """Some frames of a reader, in another order; their times rise from 0.

    Args:
        reader: of all frames. frames: which ones, in their new order.
    """

    def __init__(self, reader: PictureReader, frames: Sequence[int]) -> None:
        self._reader, self._frames = reader, tuple(frames)

    @property
    def frame_count(self) -> int:
        """Number of frames that are left."""
        return len(self._frames)

    def time(self, index: int) -> float | None:
        """Seconds since the first of these frames, to either side; None where the pictures do not say."""
        first, now = (self._reader.time(self._frames[i]) for i in (0, index))
        return None if first is None or now is None else abs(now - first)

    def image(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Decodes a picture, [H, W, 3]."""
        return self._reader.image(self._frames[index], camera)

    def has_mask(self, index: int, camera: str) -> bool:
        """True where there is a mask."""
        return self._reader.has_mask(self._frames[index], camera)

    def mask(self, index: int, camera: str) -> NDArray[np.uint8]:
        """Decodes a mask, [H, W]."""
        return self._reader.mask(self._frames[index], camera)

    def encoded_image(self, index: int, camera: str) -> bytes:
        """A picture as a file."""
        return self._reader.encoded_image(self._frames[index], camera)

    def encoded_mask(self, index: int, camera: str) -> bytes | None:
        """A mask as a file; None where there is none."""
        return self._reader.encoded_mask(self._frames[index], camera)


def of_frames(capture: Capture, frames: Sequence[int]) -> Capture:
    """The capture with these frames alone, in this order; each ``abs(step)`` of a steady order takes its longer time.

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
    """The last frame first."""
    return of_frames(capture, range(capture.frame_count)[::-1])


def every_second(capture: Capture) -> Capture:
    """Every second frame: all moves twice as far."""
    return of_frames(capture, range(0, capture.frame_count, 2))


def later(capture: Capture) -> Capture:
    """Without the first third: frame 0 is another one."""
    return of_frames(capture, range(capture.frame_count // 3, capture.frame_count))


def half_cameras(capture: Capture) -> Capture:
    """Every second training camera."""
    return replace(capture, full_rig=Rig(capture.full_rig.cameras[::2]))


VARIANTS: Mapping[str, Variant] = {
    "as it is": Variant(lambda capture: capture),
    "backwards": Variant(backwards),
    "every second": Variant(every_second),
    "half the cameras": Variant(half_cameras),
    "half the pixels": Variant(lambda capture: capture, ("scene.image_scale=0.5",)),
    "later": Variant(later),
}
"""By the name that tables have."""
