"""The arrays of a committed frame's file: its state, what effects left of it, its log, time and report. Numpy only."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.storage.births import Int
from scas4d_core.storage.npz import member

Arrays = dict[str, NDArray[Any]]
Stamp = tuple[int, int]
"""Bytes and time of change of a file, in ns: they reveal a rewritten file. Of frames in chunks: ``Chunk``."""
EVENTS = "events"
"""Array of a frame's file: the log of births, retirements and revivals up to it; only where there are any."""
EFFECTS = "effects"
"""Array of a frame's file: what effects left of it for a cold start, the bytes of an npz; only where there is any."""
EffectArrays = Mapping[str, Mapping[str, NDArray[Any]]]
"""Arrays of effects, by effect and name."""


def pack_effects(effects: EffectArrays) -> NDArray[np.uint8] | None:
    """Arrays of effects as one array of bytes; None of none.

    >>> unpack_effects(pack_effects({"shadows": {"c.0": np.arange(3)}}))
    {'shadows': {'c.0': array([0, 1, 2])}}
    """
    arrays: dict[str, Any] = {f"{name}.{key}": array for name, own in effects.items() for key, array in own.items()}
    if not arrays:
        return None
    file = BytesIO()
    np.savez(file, **arrays)
    return np.frombuffer(file.getvalue(), np.uint8)


def unpack_effects(given: NDArray[np.uint8] | None) -> dict[str, Arrays]:
    """The arrays of effects, by effect and name, that ``pack_effects`` packed."""
    effects: dict[str, Arrays] = {}
    if given is not None:
        with np.load(BytesIO(given.tobytes()), allow_pickle=False) as file:
            for name in file.files:
                effect, _, key = name.partition(".")
                effects.setdefault(effect, {})[key] = file[member(name)]
    return effects


def frame_file_arrays(
    frame: Mapping[str, NDArray[Any]], time: float, report: bytes, log: Int, left: NDArray[np.uint8] | None
) -> dict[str, Any]:
    """The arrays of a frame's file.

    Args:
        log: up to it. left: what effects left of it, packed.
    """
    if len(log):
        frame = {**frame, EVENTS: log}
    if left is not None:
        frame = {**frame, EFFECTS: left}
    return {**frame, "time": np.float64(time), "report": np.frombuffer(report, np.uint8)}
