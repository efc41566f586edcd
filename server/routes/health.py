"""Routes of health: the process answers, the service is ready, and it can take frames. None needs a token."""

from __future__ import annotations

import asyncio
import shutil

from fastapi import APIRouter, Request

from client import __version__
from client.wire import Health
from server.health.readiness import Readiness
from server.problems import Problem
from server.routes.access import AllScenes, TheSettings
from server.settings import ServerSettings

router = APIRouter(prefix="/health", tags=["service"])

ROOM_MB = 64
"""A frame of a usual rig has a few MB, and so has the state after it. Frames are taken until nothing is left."""


@router.get("/live")
async def live(scenes: AllScenes) -> Health:
    """Answers while the process runs."""
    return Health(status="live", version=__version__, scenes=len(scenes))


@router.get("/ready")
async def ready(request: Request, scenes: AllScenes, settings: TheSettings) -> Health:
    """Answers 200 once scenes are recovered and kernels compiled, else 503. `ready_after`: seconds it took.

    A full disk changes `ingest_ready` alone: views, tracks and exports go on.
    """
    scenes.recovering.check()
    readiness: Readiness = request.app.state.readiness
    after = readiness.check()
    missing = await asyncio.to_thread(room_missing, settings)
    return Health(
        status="ready", version=__version__, scenes=len(scenes), ready_after=after, ingest_ready=missing is None
    )


@router.get("/ingest")
async def ingest(scenes: AllScenes, settings: TheSettings) -> Health:
    """Answers 200 while frames can be taken, else 503: scenes are being recovered, or the disk has no room."""
    scenes.recovering.check()
    if (missing := await asyncio.to_thread(room_missing, settings)) is not None:
        raise Problem(
            503,
            missing,
            field="SCAS4D_DATA",
            remedy="free room in the service's data folder, or shorten the retention of scenes; reads go on meanwhile",
            headers={"Retry-After": "30"},
        )
    return Health(status="ready", version=__version__, scenes=len(scenes), ingest_ready=True)


def room_missing(settings: ServerSettings) -> str | None:
    """Says that the disk of the data folder has less than `ROOM_MB` free; None where it has more. Blocking."""
    free = shutil.disk_usage(settings.data).free / 1e6
    return None if free >= ROOM_MB else f"the disk of the data folder has {free:.0f} MB free, less than {ROOM_MB}"
