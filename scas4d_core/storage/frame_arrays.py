"""Arrays in the file of a committed frame: state, effect arrays, event log, time, report. Requires only NumPy."""

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
"""Size and modification time (ns) of a file, used to detect rewritten files. For frames in chunks, see ``Chunk``."""
EVENTS = "events"
"""Name of the array with the log of births, retirements and revivals up to the frame; absent if there are none."""
EFFECTS = "effects"
"""Name of the array with the effect arrays for a cold start, packed as bytes of an npz; absent if there are none."""
EffectArrays = Mapping[str, Mapping[str, NDArray[Any]]]
"""Effect arrays, keyed by effect and array name."""


def pack_effects(effects: EffectArrays) -> NDArray[np.uint8] | None:
    """Packs effect arrays into one array of bytes, or returns None if there are none.

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
    """Returns the arrays packed by ``pack_effects``, keyed by effect and array name; empty for None."""
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
    """Returns the arrays to write to the file of a frame.

    Args:
        frame: arrays of the state.
        time: time of the frame in seconds.
        report: encoded report.
        log: event log up to the frame.
        left: packed effect arrays, or None if there are none.
    """
    if len(log):
        frame = {**frame, EVENTS: log}
    if left is not None:
        frame = {**frame, EFFECTS: left}
    return {**frame, "time": np.float64(time), "report": np.frombuffer(report, np.uint8)}
