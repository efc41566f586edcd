"""Route that estimates the memory and disk usage of a scene before it is created."""

from __future__ import annotations

from fastapi import APIRouter

from client.wire import SceneCreate
from client.wire.estimate import SceneEstimate
from server.health.estimate import estimate
from server.routes.access import TheSettings
from server.routes.scenes import scene_settings

router = APIRouter(prefix="/v1/estimate", tags=["service"])


@router.post("")
async def of_scene(request: SceneCreate, server: TheSettings) -> SceneEstimate:
    """Estimates the memory and disk usage of a scene without creating it.

    Scenes that exceed the service's limit cannot be created.
    """
    return estimate(request.rig, scene_settings(request), server)
