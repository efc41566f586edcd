"""The same pictures again: a camera at half the rate of its rig, or a rig that sends its last frame while it waits.

Nothing is learnt from them, and that nothing moved is not believed either: the next frame is looked for where the
motion before them leads.
"""

from __future__ import annotations

from collections.abc import Mapping
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from scas4d_core.robust.solve_frame import Given, Outcome, stood
from scas4d_core.update.result import Updated

EVERY = 4
"""Rows and columns apart of the pixels that are compared: pictures of a camera are never alike by chance."""


def fingerprints(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, int]:
    """CRC-32 of every fourth pixel of every fourth row of each camera's picture [H, W, 3]."""
    return {name: crc32(picture[::EVERY, ::EVERY].tobytes()) for name, picture in pictures.items()}


def same_again(given: Given) -> Outcome:
    """The outcome of a frame that shows what the last one that was believed showed."""
    nothing = Updated.nothing(given.state, given.motion)
    return stood(given, nothing, given.look.exposure, "the same pictures again")
