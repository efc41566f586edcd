"""Is the service there, and can it work?"""

from __future__ import annotations

from fastapi import APIRouter, Request

from client import __version__
from client.wire import Health
from server.health.readiness import Readiness
from server.routes.access import AllScenes

router = APIRouter(prefix="/health", tags=["service"])


@router.get("/live")
async def live(scenes: AllScenes) -> Health:
    """The process answers. The only request that never asks for a token."""
    return Health(status="live", version=__version__, scenes=len(scenes.by_id))


@router.get("/ready")
async def ready(request: Request, scenes: AllScenes) -> Health:
    """Scenes are recovered and kernels compiled; `ready_after` says how long the kernels took. 503 until then."""
    scenes.check_recovered()
    readiness: Readiness = request.app.state.readiness
    return Health(status="ready", version=__version__, scenes=len(scenes.by_id), ready_after=readiness.check())
