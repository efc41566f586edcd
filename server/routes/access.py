"""Dependencies of the routes: the scenes, the settings, one scene, and its answer to a query."""

from __future__ import annotations

import asyncio
import contextlib
import difflib
from collections.abc import AsyncIterator
from typing import Annotated
from urllib.parse import parse_qsl

from fastapi import Depends, Path, Request, params
from fastapi.dependencies.utils import get_flat_params
from fastapi.routing import APIRoute
from starlette.requests import HTTPConnection

from server.problems import Problem
from server.processes.queries import Answer, Query
from server.scene.exports import Exports
from server.scene.scene import Scene
from server.scene.scenes import Scenes
from server.settings import ServerSettings


def _scenes(request: Request) -> Scenes:
    scenes: Scenes = request.app.state.scenes
    return scenes


def _exports(request: Request) -> Exports:
    exports: Exports = request.app.state.exports
    return exports


def _settings(request: Request) -> ServerSettings:
    settings: ServerSettings = request.app.state.settings
    return settings


SceneId = Annotated[str, Path(max_length=64)]


async def _scene(request: Request, id: SceneId) -> AsyncIterator[Scene]:
    async with _scenes(request).use(id) as scene:
        yield scene


async def _record(request: Request, id: SceneId) -> AsyncIterator[Scene]:
    async with _scenes(request).use(id, place=False) as scene:
        yield scene


AllScenes = Annotated[Scenes, Depends(_scenes)]
AllExports = Annotated[Exports, Depends(_exports)]
TheSettings = Annotated[ServerSettings, Depends(_settings)]
TheScene = Annotated[Scene, Depends(_scene)]
"""For what needs its processes: it is woken, and gets a place."""
TheRecord = Annotated[Scene, Depends(_record)]
"""For what is known without them: it is read back from its folder, whether there is a place or not."""
FrameIndex = Annotated[int, Path(ge=0, le=1_000_000_000)]


def known(route: APIRoute) -> list[str]:
    """Returns the names of a route's query parameters, in its own order."""
    fields = get_flat_params(route.dependant)
    return list(dict.fromkeys(field.alias for field in fields if isinstance(field.field_info, params.Query)))


def only_known(connection: HTTPConnection) -> None:
    """Refuses query parameters that the route does not know: a misspelt one is noticed.

    Raises:
        Problem: 422, names the parameter and those that there are.
    """
    route = connection.scope.get("route")
    if not isinstance(route, APIRoute):  # a WebSocket
        return
    names = known(route)
    query = connection.scope.get("query_string", b"").decode("latin-1")
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name in names:
            continue
        near = difflib.get_close_matches(name, names, 1)
        meant = f"it may be {near[0]!r} that is meant; " if near else ""
        there = f"the parameters here are {', '.join(names)}" if names else "this address takes no parameters"
        raise Problem(422, f"there is no parameter {name!r} here", field=name, value=value, remedy=meant + there)


async def ask(request: Request, scene: Scene, query: Query) -> Answer:
    """Asks the scene's readers; the query is cancelled if the client hangs up. The body has been read before.

    Raises:
        Problem: as `Readers.ask`; 503, the client has hung up.
    """
    asking = asyncio.ensure_future(scene.readers.ask(query))
    leaving = asyncio.ensure_future(_hung_up(request))
    try:
        await asyncio.wait({asking, leaving}, return_when=asyncio.FIRST_COMPLETED)
        if asking.done():
            return asking.result()
    finally:
        for task in (asking, leaving):
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError, Exception):
                await task
    raise Problem(503, "the client has hung up", remedy="ask again")


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
