"""Application factory: middleware, routes, and the lifespan of the service."""

from __future__ import annotations

import json
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import APIRouter, Depends, FastAPI
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute

from client import __version__
from server.connections.client_limit import ClientLimit
from server.connections.guard import ConnectionGuard, ConnectionLimits
from server.health.readiness import Readiness
from server.http import handlers
from server.http.authentication import AuthMiddleware
from server.http.middleware import AccessLog, BodyLimit, HeadAsGet, compress_responses
from server.http.openapi import RESPONSES
from server.http.tickets import Tickets
from server.hub import Hub
from server.peers.peers import Peers
from server.peers.proxy import ProxyMiddleware
from server.problems import Problem
from server.processes.placement import Placement
from server.routes import (
    access,
    budget,
    exports,
    frames,
    ingest,
    parts,
    points,
    reference,
    render,
    scenes,
    service,
    stream,
    tracks,
    tradeoff,
    viewer,
)
from server.scene.exports import Exports
from server.scene.scenes import Scenes
from server.settings import ServerSettings


def create_app(settings: ServerSettings | None = None, placement: Placement | None = None) -> FastAPI:
    """Creates the ASGI application of the service.

    Run it with `server.connections.config.uvicorn_config`, as `scas4d serve` does. It also runs under
    `uvicorn --factory server.app:create_app`, but then nothing limits how much data a peer can send before its token
    is checked.
    """
    settings = settings or ServerSettings.from_environment()
    if logging.getLogger("scas4d").level == logging.NOTSET:  # otherwise `serve` has set it
        logging.getLogger("scas4d").setLevel(logging.INFO)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        settings.data.mkdir(parents=True, exist_ok=True)
        app.state.hub = Hub(settings.max_subscribers)
        app.state.placement = where = placement or Placement()
        await where.open()
        app.state.readiness = Readiness(settings, where)
        app.state.scenes = Scenes(settings, where, app.state.hub)
        await app.state.scenes.open()
        app.state.peers = Peers(where.peers, settings.secret) if where.has_peers else None
        app.state.exports = Exports(app.state.scenes, where)
        await app.state.exports.open()
        yield
        await app.state.exports.stop()
        await app.state.readiness.stop()
        await app.state.scenes.stop()
        if app.state.peers is not None:
            await app.state.peers.close()
        await where.close()

    app = FastAPI(
        title="SCas4D",
        version=__version__,
        summary="Online 4D reconstruction from calibrated multi-camera rigs.",
        lifespan=lifespan,
        responses=RESPONSES,
        docs_url=None,  # `routes.reference` serves the API reference
        redoc_url=None,
    )
    app.state.settings = settings
    app.state.guard = ConnectionGuard(ConnectionLimits.of(settings))
    app.state.tickets = Tickets(settings.secret)
    handlers.install_handlers(app)
    # The middleware added last is the first to receive a request.
    app.add_middleware(BodyLimit, limit=int(settings.max_body_mb * 1e6))
    app.add_middleware(compress_responses)
    app.add_middleware(HeadAsGet)
    if placement is not None and placement.has_peers:
        app.add_middleware(
            ProxyMiddleware,
            peers=lambda: app.state.peers,
            has=lambda id: id in app.state.scenes,
            most_bytes=int(settings.max_body_mb * 1e6),
        )
    if settings.allowed_origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=settings.allowed_origins,
            allow_methods=["*"],
            allow_headers=["Authorization", "Content-Type"],
            expose_headers=["*"],
        )
    app.add_middleware(AuthMiddleware, settings=settings, tickets=app.state.tickets)
    if settings.trusted_proxies:
        app.add_middleware(ClientLimit, guard=app.state.guard)
    app.add_middleware(AccessLog)
    of_scenes = (scenes, points, frames, ingest, render, tracks, parts, stream)
    resources = (*of_scenes, budget, tradeoff, exports, service, viewer, reference)
    for resource in resources:
        app.include_router(
            resource.router, dependencies=[] if resource in (viewer, reference) else [Depends(access.only_known)]
        )
        _answer_plain_requests(app, resource.router)
    _keep_document(app)
    return app


def _keep_document(app: FastAPI) -> None:
    """Serves /openapi.json from memory, since it needs no token and takes milliseconds to generate."""
    kept: list[bytes] = []

    async def openapi(request: Request) -> Response:
        if not kept:
            kept.append(json.dumps(app.openapi(), ensure_ascii=False, separators=(",", ":")).encode())
        return Response(kept[0], media_type="application/json")

    assert app.openapi_url is not None
    app.router.routes.insert(0, Route(app.openapi_url, openapi, methods=["GET"], include_in_schema=False))


def _answer_plain_requests(app: FastAPI, router: APIRouter) -> None:
    """Responds with 426 instead of 404 to a plain HTTP request at the URL of a WebSocket."""

    async def upgrade(request: Request) -> Response:
        raise Problem(
            426,
            "this URL is a WebSocket endpoint",
            field="Upgrade",
            remedy="connect with ws:// or wss://",
            headers={"Upgrade": "websocket", "Connection": "Upgrade"},
        )

    for route in router.routes:
        if isinstance(route, WebSocketRoute):
            app.add_route(route.path, upgrade, methods=["GET"], include_in_schema=False)
