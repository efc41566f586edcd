"""Routes for the budget, which limits the iterations and time of a scene's updates."""

from __future__ import annotations

from fastapi import APIRouter

from client.wire import Budget, SceneBudget
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
    await scene.set_budget(budget)
    return scene.budget()
