"""Routes of health: the process answers, and the service is ready."""

from __future__ import annotations

from fastapi import APIRouter, Request

from client import __version__
from client.wire import Health
from server.health.readiness import Readiness
from server.routes.access import AllScenes

router = APIRouter(prefix="/health", tags=["service"])


@router.get("/live")
async def live(scenes: AllScenes) -> Health:
    """Answers while the process runs. This is the only request of the API that never asks for a token."""
    return Health(status="live", version=__version__, scenes=len(scenes))


@router.get("/ready")
async def ready(request: Request, scenes: AllScenes) -> Health:
    """Answers 200 once scenes are recovered and kernels compiled, else 503. `ready_after`: seconds it took."""
    scenes.recovering.check()
    readiness: Readiness = request.app.state.readiness
    return Health(status="ready", version=__version__, scenes=len(scenes), ready_after=readiness.check())
