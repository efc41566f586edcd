"""The interface of an effect: its words for users, the part that it puts into an update, the evidence for it.

Modules of effects load neither Numba nor torch when they are imported: settings are checked with them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib import import_module
from operator import attrgetter
from typing import TYPE_CHECKING

from scas4d_core.effect_names import EFFECTS

if TYPE_CHECKING:
    from scas4d_core.effects.evidence import Evidence, FrameObservation
    from scas4d_core.settings import Settings
    from scas4d_core.update.parts import Arrays, PlanBuilder
    from scas4d_core.update.result import UpdateResult


class EffectGroup(StrEnum):
    """The kinds of effects."""

    MOTION = "motion"
    COHERENCE = "coherence"
    APPEARANCE = "appearance"
    CAMERAS = "cameras"
    PRESENCE = "presence"


@dataclass(frozen=True)
class Effect:
    """An effect; its module has one instance, called ``EFFECT``.

    Attributes:
        name: as in ``effect_names.EFFECTS``. group: of the effects that it stands beside.
        description: a sentence for users. disambiguation: that which fixes it against the effects that could explain
            the same pixels.
        cost: of an update with it, against one without.
        auto: whether it waits for evidence; else it is on wherever it is not refused.
        on_above, off_below: share of ``Evidence`` from which it is switched on, and below which it is switched off.
        without_masks: whether it is anything in a scene whose first frame has no masks.
        committed_arrays: names of its arrays in ``Attempt.carried`` that are committed with each frame: a cold start,
            without a
            checkpoint, has these, and those of ``first_frame_arrays``. They are small.
    """

    name: str
    group: EffectGroup
    description: str
    disambiguation: str
    cost: str
    auto: bool = False
    on_above: float = 0.0
    off_below: float = 0.0
    without_masks: bool = True
    committed_arrays: tuple[str, ...] = ()

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Fault and remedy where it cannot be on under these settings; None: it can."""
        return None

    def first_frame_arrays(self, seen: FrameObservation) -> Arrays | None:
        """Arrays of frame 0 that evidence or part look back to; None: none. Not asked where it is pinned off."""
        return None

    def requirement(self, settings: Settings) -> tuple[str, str] | None:
        """Fault and remedy where these settings pin it off and nothing else does its work; None: it can be off."""
        return None

    def on_at_first(self, seen: FrameObservation) -> bool:
        """True where it is on after the first frame until it is idle; it keeps arrays of that frame."""
        return False

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """The evidence of a frame that calls for it; None: the frame says nothing, and the switch stays."""
        return None

    def record(self, seen: FrameObservation, on: bool) -> Arrays | None:
        """Its arrays for the frames after, beside what its part leaves; None: those that it has stay.

        Called after each frame that was learnt, before evidence is taken, and also where it is off and not pinned so.

        Args:
            on: whether it took part in the frame.
        """
        return None

    def add_and_retire_gaussians(self, seen: FrameObservation) -> UpdateResult:
        """The result of a frame with the Gaussians that are born, retired or revived in it.

        Called where it is on, after each frame that was learnt and before its commit; nowhere else may rows change.
        Rows stay where they are: ``replace(seen.result, gaussians=..., parents=..., carried=...)``, the Gaussians made
        by ``Gaussians.concatenate``, ``retire`` and ``revive``. ``parents`` has those of effects before, too. Arrays in
        ``carried`` with a row for each Gaussian are lengthened afterwards: the born have the rows of their parents,
        or zeros.
        """
        return seen.result

    def register(self, builder: PlanBuilder) -> None:
        """Puts its part into the updates of a scene; called only where it is on."""
        raise NotImplementedError


Refusal = tuple[str, str]
"""Fault and remedy."""


def refusal_at_zero(settings: Settings, key: str) -> Refusal | None:
    """Fault and remedy where a rate or weight of the update is 0.

    Args:
        key: in the settings of the update, as "rate_colour" and "weights.rigidity".
    """
    if attrgetter(key)(settings.update) > 0:
        return None
    return f"update.{key} is 0", f"give it a {'weight' if key.startswith('weights.') else 'rate'} above 0"


@cache
def effect(name: str) -> Effect:
    """The effect of a name.

    Raises:
        KeyError: there is none.

    >>> effect("floor").group
    <EffectGroup.COHERENCE: 'coherence'>
    """
    instance: Effect = import_module(EFFECTS[name]).EFFECT
    return instance
