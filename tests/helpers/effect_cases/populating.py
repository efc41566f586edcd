"""An effect that bears, retires and revives Gaussians by a plan, for tests of what follows from that."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest

from scas4d_core.effect_names import EFFECTS
from scas4d_core.effects import effect as effect_module
from scas4d_core.effects.effect import Effect, EffectGroup
from scas4d_core.effects.evidence import FrameObservation
from scas4d_core.update.result import UpdateResult

NAME, MODULE = "planned", "planned_population"
Plan = Callable[[FrameObservation], UpdateResult]


class Planned(Effect):
    """Does what its plan says."""

    plan: Plan

    def add_and_retire_gaussians(self, seen: FrameObservation) -> UpdateResult:
        return type(self).plan(seen)

    def register(self, builder: object) -> None:
        """It has no part."""


def install(monkeypatch: pytest.MonkeyPatch, plan: Plan) -> None:
    """Puts the effect into the registry; it is on wherever it is not pinned off."""

    class Own(Planned):
        pass

    Own.plan = staticmethod(plan)  # type: ignore[assignment]
    module = ModuleType(MODULE)
    module.EFFECT = Own(NAME, EffectGroup.PRESENCE, "says", "gauge", "cost")  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, MODULE, module)
    monkeypatch.setitem(EFFECTS, NAME, MODULE)
    effect_module.effect.cache_clear()


def plan(
    births: dict[int, tuple[list[int], list[int]]] | None = None,
    retired: dict[int, list[int]] | None = None,
    revived: dict[int, list[int]] | None = None,
) -> Plan:
    """A plan by frame: the rows that are copied, shifted a little, with the parents; rows retired; rows revived."""

    def add_and_retire_gaussians(seen: FrameObservation) -> UpdateResult:
        state, parents = seen.result.gaussians, seen.result.parents
        carried = dict(seen.result.carried)
        if seen.index in (births or {}):
            rows, parents = (births or {})[seen.index]
            born = state.rows(rows)
            born = born.replace(means=born.means + np.float32([0.01, 0, 0]))
            state, parents = state.concatenate(born), np.array(parents, np.int64)
        if seen.index in (retired or {}):
            state = state.retire((retired or {})[seen.index])
        if seen.index in (revived or {}):
            state = state.revive((revived or {})[seen.index])
        carried[NAME] = {"rows": np.arange(len(seen.result.gaussians), dtype=np.float32), "seen": np.int64(seen.index)}
        return replace(seen.result, gaussians=state, parents=parents, carried=carried)

    return add_and_retire_gaussians
