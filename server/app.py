"""The application factory."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from fastapi.responses import RedirectResponse

from client import __version__
from server import problems
from server.hub import Hub
from server.limits import BodyLimit
from server.placement import Placement
from server.placement.local import LocalPlacement
from server.routes import frames, health, parts, points, render, scenes, stream, tracks
from server.scenes import Scenes
from server.settings import ServerSettings


def create_app(settings: ServerSettings | None = None, placement: Placement | None = None) -> FastAPI:
    """The service; `uvicorn --factory server.app:create_app` runs it with settings from the environment."""
    settings = settings or ServerSettings.from_environment()
    logging.getLogger("scas4d").setLevel(logging.INFO)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        settings.data.mkdir(parents=True, exist_ok=True)
        app.state.hub = Hub(settings.max_subscribers, settings.stream_questions)
        app.state.scenes = Scenes(settings, placement or LocalPlacement(), app.state.hub)
        yield
        await app.state.scenes.stop()

    app = FastAPI(
        title="SCas4D",
        version=__version__,
        summary="Online 4D reconstruction of calibrated multi-camera rigs.",
        lifespan=lifespan,
        responses=problems.RESPONSES,
    )
    app.state.settings = settings
    problems.install(app)
    app.add_middleware(BodyLimit, limit=int(settings.max_body_mb * 1e6))
    for resource in (scenes, points, frames, render, tracks, parts, stream, health):
        app.include_router(resource.router)

    @app.get("/", include_in_schema=False)
    async def root() -> RedirectResponse:
        return RedirectResponse("/docs")

    return app
