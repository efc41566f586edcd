"""`Frame`, the images and masks of one time step by camera, and `InitialPoints` of a scene. Needs only numpy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Frame:
    """The images of all cameras at one time step.

    Attributes:
        index: 0, 1, 2, … in temporal order.
        time: seconds since the first frame.
        images: images by camera name, [H, W, 3] uint8, sRGB values as in the file. Entries may be decoded lazily on
            access.
        masks: masks by camera name, [H, W] uint8, 1 on the foreground; empty if the capture has no masks.

    >>> picture = np.zeros((48, 64, 3), np.uint8)
    >>> frame = Frame(index=3, time=0.1, images={"front": picture, "left": picture}, masks={})
    >>> sorted(frame.images)
    ['front', 'left']
    """

    index: int
    time: float
    images: Mapping[str, NDArray[np.uint8]]
    masks: Mapping[str, NDArray[np.uint8]]


@dataclass(eq=False)
class InitialPoints:
    """A point cloud on the surfaces of frame 0, from which the fit of frame 0 starts.

    Attributes:
        positions: [P, 3] float64, in the user's units and axes.
        colours: [P, 3] float32 in 0…1, sRGB values as in the images.
        foreground: [P] float32 in 0…1, or None if unknown.

    >>> cloud = InitialPoints(np.zeros((5, 3)), np.full((5, 3), 0.5, np.float32))
    >>> len(cloud), cloud.foreground is None
    (5, True)
    """

    positions: NDArray[np.float64]
    colours: NDArray[np.float32]
    foreground: NDArray[np.float32] | None = None

    def __len__(self) -> int:
        return len(self.positions)
