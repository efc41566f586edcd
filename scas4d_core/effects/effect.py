"""Interface that every effect implements: descriptions for users, a contribution to updates, and evidence.

Effect modules must not import Numba or torch at import time, because the validation of settings imports them.
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
    """A group of related effects."""

    MOTION = "motion"
    COHERENCE = "coherence"
    APPEARANCE = "appearance"
    CAMERAS = "cameras"
    PRESENCE = "presence"


@dataclass(frozen=True)
class Effect:
    """A named part of an update. Each effect module defines one instance, named ``EFFECT``.

    Attributes:
        name: key in ``effect_names.EFFECTS``.
        group: group of related effects.
        description: one sentence for users.
        disambiguation: how the effect is distinguished from other effects that could explain the same pixels.
        cost: additional cost of an update with the effect.
        auto: whether only evidence switches the effect on. Other effects are on unless they are refused or pinned off.
        on_above: the effect is switched on if ``Evidence.share`` is at least this value.
        off_below: the effect is switched off if ``Evidence.share`` is below this value.
        without_masks: whether the effect can be on in a scene whose first frame has no masks.
        positive_setting: learning rate or weight in the update settings that must be above 0, such as "rate_colour" or
            "weights.rigidity"; empty if the effect has none.
        committed_arrays: names of the effect's arrays in ``Attempt.carried`` that are committed with each frame. They
            should be small. Only these arrays and those from ``first_frame_arrays`` survive the loss of a checkpoint.
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
    positive_setting: str = ""
    committed_arrays: tuple[str, ...] = ()

    def refusal(self, settings: Settings) -> tuple[str, str] | None:
        """Returns the problem and its remedy if the effect cannot be on with these settings, or None if it can."""
        key = self.positive_setting
        if not key or attrgetter(key)(settings.update) > 0:
            return None
        return f"update.{key} is 0", f"use a {'weight' if key.startswith('weights.') else 'rate'} above 0"

    def first_frame_arrays(self, seen: FrameObservation) -> Arrays | None:
        """Returns the arrays from frame 0 that the effect needs in later frames, or None if it does not need any.

        Not called if the effect is refused or pinned off.
        """
        return None

    def requirement(self, settings: Settings) -> tuple[str, str] | None:
        """Returns the problem and its remedy if the effect cannot be off with these settings, or None if it can."""
        return None

    def on_at_first(self, seen: FrameObservation) -> bool:
        """Returns whether frame 0 switches the effect on. Called only if ``first_frame_arrays`` returned arrays."""
        return False

    def evidence(self, seen: FrameObservation) -> Evidence | None:
        """Returns the evidence from a learnt frame, or None to leave the switch unchanged."""
        return None

    def record(self, seen: FrameObservation, on: bool) -> Arrays | None:
        """Returns arrays for later frames that replace the effect's carried arrays, or None to keep the existing ones.

        Called after each learnt frame, before the evidence is computed. It is also called while the effect is off,
        unless it is pinned off.

        Args:
            seen: the learnt frame.
            on: whether the effect was on during the update of the frame.
        """
        return None

    def add_and_retire_gaussians(self, seen: FrameObservation) -> UpdateResult:
        """Returns the result of a frame with Gaussians added, retired or revived.

        Called while the effect is on, after each learnt frame and before its commit. No other method may change the
        number or order of rows. Existing rows must keep their order: return ``replace(seen.result, gaussians=...,
        parents=..., carried=...)`` with Gaussians from ``Gaussians.concatenate``, ``retire`` and ``revive``.
        ``parents`` must also contain the parents from previous effects. Afterwards, arrays in ``carried`` with one row
        per Gaussian are extended by copies of the parents' rows, or by zeros for Gaussians without a parent.
        """
        return seen.result

    def register(self, builder: PlanBuilder) -> None:
        """Adds the effect's part to the updates of a scene; called only if the effect is on."""
        raise NotImplementedError


@cache
def effect(name: str) -> Effect:
    """Returns the effect with the given name.

    Raises:
        KeyError: if there is no such effect.

    >>> effect("floor").group
    <EffectGroup.COHERENCE: 'coherence'>
    """
    instance: Effect = import_module(EFFECTS[name]).EFFECT
    return instance
