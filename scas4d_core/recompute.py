"""Recomputes a committed state that was damaged on disk, from the images of its frame.

The recomputation is a cold start from the previous state. The result looks like the original state
but is not bit-identical. The report of the result contains ``recomputed``. Later states were
computed from the original state and do not change.
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
"""Key in the report of a recomputed state; its value is true."""


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
    """Recomputes the state of a frame and replaces the damaged one.

    Args:
        rig: training cameras in the user's world.
        settings: settings of the scene.
        history: history of the scene, in the process that appends to it.
        base: index of the previous committed frame.
        frame: frame whose state is damaged, with its images.
        budget: budget that applied to the frame, as keyword arguments of
            ``Reconstruction.set_budget``.
        dropped: maps each camera excluded by the caller to the reason.
        notes: additional JSON data to commit.

    Returns:
        The report written with the state.

    Raises:
        HistoryError: if the first frame or ``base`` cannot be read.
        StepError: if the frame does not follow ``base``, its images do not match the rig, or the
            update is rejected.
    """
    scratch = Reconstruction.fork(rig, settings, history, base)
    # Later states already contain the Gaussians that were added and retired in this frame.
    scratch.may_change_population = False
    scratch.set_budget(**budget)
    made = scratch.step(frame, dropped=dropped, notes={**(notes or {}), RECOMPUTED: True})
    if made.outcome.rejected:  # nothing was learnt from the images
        raise StepError(f"frame {frame.index} does not fit the previous frame: {made.degraded}")
    report = scratch.history.report(frame.index)
    arrays = history.complete_state(frame.index, scratch.history.gaussians(frame.index)).arrays()
    kept = {name: arrays[name] for name in (*PER_FRAME, *WHOLES) if name in arrays}
    # The arrays of presence effects are omitted. They would not describe the Gaussians that the
    # history contains for this frame, because this update added and retired none.
    left = scratch.history.effects(frame.index)
    left = {name: given for name, given in left.items() if effect(name).group is not EffectGroup.PRESENCE}
    history.replace(frame.index, frame.time, kept, report, left)
    return report
