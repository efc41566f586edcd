"""Routes for the budget, which limits the iterations and time of a scene's updates."""

from __future__ import annotations

from fastapi import APIRouter

from client.wire import Budget, SceneBudget
from server.problems import Problem
from server.routes.access import TheRecord

router = APIRouter(prefix="/v1/scenes", tags=["budget"])


@router.get("/{id}/budget")
async def get(scene: TheRecord) -> SceneBudget:
    """Returns the budget for frames whose reconstruction has not started."""
    return scene.budget()


@router.put("/{id}/budget")
async def put(scene: TheRecord, budget: Budget) -> SceneBudget:
    """Sets the budget for all frames whose reconstruction has not started; null restores the scene's setting.

    The budget is on disk when the response is sent. After a crash or restart, each frame keeps the budget that applied
    to it.
    """
    if budget.keep_up_fps is not None and budget.budget_ms is not None:
        raise Problem(
            422,
            "both keep_up_fps and budget_ms are set",
            field="budget_ms",
            value=budget.budget_ms,
            remedy="set one of them; keep_up_fps determines the milliseconds per frame",
        )
    await scene.set_budget(budget)
    return scene.budget()
