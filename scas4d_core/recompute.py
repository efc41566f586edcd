"""Recomputes a committed state that was damaged on disk, from the pictures of its frame.

The recomputed state starts cold from the state before it. It shows the same with other bits, and its report says
``recomputed``. Later states were made from the original and stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from scas4d_core.cameras import Rig
from scas4d_core.captures.frame import Frame
from scas4d_core.effects.effect import EffectGroup, effect
from scas4d_core.gaussians import PER_FRAME, WHOLES
from scas4d_core.reconstruction import Reconstruction, StepError
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History

RECOMPUTED = "recomputed"
"""In the report of a state that was made again: true."""


def recompute(
    rig: Rig,
    settings: Settings,
    history: History,
    base: int,
    frame: Frame,
    budget: Mapping[str, Any],
    *,
    dropped: Mapping[str, str] | None = None,
    notes: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Makes the state of a frame again and writes it in its place.

    Args:
        rig: training cameras, user's world. settings: of the scene.
        history: of the scene, of the process that appends.
        base: the committed frame before it. frame: its pictures.
        budget: that held for it (``Reconstruction.set_budget``).
        dropped, notes: see ``Reconstruction.step``.

    Returns:
        The report that was written with it.

    Raises:
        HistoryError: the first frame or ``base`` cannot be read.
        StepError: the frame does not follow ``base``, or does not fit it.
    """
    scratch = Reconstruction.fork(rig, settings, history, base)
    scratch.may_change_population = False  # what came and went in it is known, and states after it have it
    scratch.set_budget(**budget)
    made = scratch.step(frame, dropped=dropped, notes={**(notes or {}), RECOMPUTED: True})
    if made.outcome.rejected:  # nothing was learnt from the pictures
        raise StepError(f"frame {frame.index} does not fit the frame before it: {made.degraded}")
    report = scratch.history.report(frame.index)
    arrays = history.complete_state(frame.index, scratch.history.gaussians(frame.index)).arrays()
    kept = {name: arrays[name] for name in (*PER_FRAME, *WHOLES) if name in arrays}
    # Who was newborn in it is not known: its births are those of the history, not of this update.
    left = scratch.history.effects(frame.index)
    left = {name: given for name, given in left.items() if effect(name).group is not EffectGroup.PRESENCE}
    history.replace(frame.index, frame.time, kept, report, left)
    return report
