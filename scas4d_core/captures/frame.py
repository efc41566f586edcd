"""`Frame`, the images and masks of one time step, and `InitialPoints`, a point cloud.

This module requires only NumPy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Frame:
    """The images and masks of a rig's cameras at one time step.

    Attributes:
        index: position in temporal order, starting at 0. Frames between two indices count as missing, and
            lengthen the update after them.
        time: time since the first frame, in seconds.
        images: maps each camera name to its image, [H, W, 3] uint8, sRGB values as in the file.
            Images may be decoded lazily, on access.
        masks: maps each camera name to its mask, [H, W] uint8, 1 on the foreground. Empty if the
            frame has no masks.
        files: maps camera names to the image files from which ``decode_image`` decoded ``images`` without
            arguments that change the pixels; may be empty. Checkpoints contain these files instead of
            larger pixels.

    >>> picture = np.zeros((48, 64, 3), np.uint8)
    >>> frame = Frame(index=3, time=0.1, images={"front": picture, "left": picture}, masks={})
    >>> sorted(frame.images)
    ['front', 'left']
    """

    index: int
    time: float
    images: Mapping[str, NDArray[np.uint8]]
    masks: Mapping[str, NDArray[np.uint8]]
    files: Mapping[str, bytes | memoryview] = field(default_factory=dict)


@dataclass(eq=False)
class InitialPoints:
    """A point cloud on the surfaces of frame 0, used to initialize the fit of that frame.

    Attributes:
        positions: [P, 3] float64 point positions, in the user's units and axes.
        colours: [P, 3] float32 point colours in [0, 1], sRGB values as in the images.
        foreground: [P] float32 foreground label of each point in [0, 1], or None if unknown.

    >>> cloud = InitialPoints(np.zeros((5, 3)), np.full((5, 3), 0.5, np.float32))
    >>> len(cloud), cloud.foreground is None
    (5, True)
    """

    positions: NDArray[np.float64]
    colours: NDArray[np.float32]
    foreground: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.positions)
