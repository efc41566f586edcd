"""What a scene's updates may cost: as it was made, or as it was put since."""

from __future__ import annotations

from typing import TYPE_CHECKING

from client.wire import Budget, EffectiveBudget, SceneBudget
from scas4d_core.settings import Settings

if TYPE_CHECKING:
    from server.scene.scene import Scene


def effective(settings: Settings, budget: Budget) -> EffectiveBudget:
    """The settings of the scene with what was put over them."""
    update = settings.update
    return EffectiveBudget(
        iterations=update.iterations if budget.iterations is None else budget.iterations,
        budget_ms=update.budget_ms if budget.budget_ms is None else budget.budget_ms,
        stop_gain=update.stop_gain if budget.stop_gain is None else budget.stop_gain,
        still=update.still if budget.still is None else budget.still,
    )


def scene_budget(scene: Scene) -> SceneBudget:
    """What holds for the frames of a scene that are not begun."""
    since, asked = scene.ledger.budgets[-1]
    return SceneBudget(scene=scene.id, asked=asked, effective=effective(scene.spec.settings, asked), since=since)
