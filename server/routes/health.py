"""Health check routes for liveness, readiness and frame ingest; none requires a token."""

from __future__ import annotations

import asyncio
import os
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
"""Free disk space in MB below which the service reports that it is not ready for ingest.

A typical frame takes a few MB, and so does its state. Frames are still accepted until the disk is full.
"""


@router.get("/live")
async def live(scenes: AllScenes) -> Health:
    """Returns 200 while the process is running."""
    return Health(status="live", version=__version__, scenes=len(scenes), process=os.getpid())


@router.get("/ready")
async def ready(request: Request, scenes: AllScenes, settings: TheSettings) -> Health:
    """Returns 200 once scenes are recovered and kernels compiled, else 503; `ready_after` is the startup time in s.

    A full disk affects only `ingest_ready`: views, tracks and exports keep working.
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
    """Returns 200 while frames can be accepted, or 503 if scenes are being recovered or the disk is full."""
    scenes.recovering.check()
    if (missing := await asyncio.to_thread(room_missing, settings)) is not None:
        raise Problem(
            503,
            missing,
            field="SCAS4D_DATA",
            remedy="free space in the service's data folder, or shorten the retention of scenes; reading still works",
            headers={"Retry-After": "30"},
        )
    return Health(status="ready", version=__version__, scenes=len(scenes), ingest_ready=True)


def room_missing(settings: ServerSettings) -> str | None:
    """Returns a message if the data folder's disk has less than `ROOM_MB` MB free, otherwise None. Blocking."""
    free = shutil.disk_usage(settings.data).free / 1e6
    return None if free >= ROOM_MB else f"the disk of the data folder has {free:.0f} MB free; {ROOM_MB} MB are required"
