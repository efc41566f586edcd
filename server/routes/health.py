"""Is the service there, and does it take scenes?"""

from __future__ import annotations

from fastapi import APIRouter

from client import __version__
from client.wire import Health
from server.routes.access import AllScenes

router = APIRouter(prefix="/health", tags=["health"])


@router.get("/live")
async def live(scenes: AllScenes) -> Health:
    """The process answers."""
    return Health(status="live", version=__version__, scenes=len(scenes.by_id))


@router.get("/ready")
async def ready(scenes: AllScenes) -> Health:
    """The service takes scenes. Kernels are compiled by each scene's own process, at its first frame."""
    return Health(status="ready", version=__version__, scenes=len(scenes.by_id))
