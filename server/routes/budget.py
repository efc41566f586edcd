"""Routes of the budget: the limits of a scene's updates."""

from __future__ import annotations

from fastapi import APIRouter

from client.wire import Budget, SceneBudget
from server.routes.access import TheRecord

router = APIRouter(prefix="/v1/scenes", tags=["budget"])


@router.get("/{id}/budget")
async def get(scene: TheRecord) -> SceneBudget:
    """Returns the budget of frames that are not begun."""
    return scene.budget()


@router.put("/{id}/budget")
async def put(scene: TheRecord, budget: Budget) -> SceneBudget:
    """Sets the budget from the first frame on that is not begun; null takes the scene's own setting.

    It is on disk when this answers: after any end of the service each frame gets the budget that held for it.
    """
    await scene.set_budget(budget)
    return scene.budget()
