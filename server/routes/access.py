"""Shared dependencies of the routes: scenes, exports, settings, query parameter checks and reader queries."""

from __future__ import annotations

import difflib
from collections.abc import AsyncIterator
from typing import Annotated, Any
from urllib.parse import parse_qsl

from fastapi import Depends, Path, Request, params
from fastapi.dependencies.utils import get_flat_params
from fastapi.routing import APIRoute
from starlette.requests import HTTPConnection

from server.background import run_until_first
from server.problems import Problem
from server.processes.queries import Answer, Query
from server.scene.exports import Exports
from server.scene.scene import Scene
from server.scene.scenes import Scenes
from server.settings import ServerSettings


def _of_app(name: str) -> Any:
    """Returns the dependency that reads an attribute of the application's state."""

    async def read(request: Request) -> Any:  # not in a thread, because it does not block
        return getattr(request.app.state, name)

    return Depends(read)


AllScenes = Annotated[Scenes, _of_app("scenes")]
AllExports = Annotated[Exports, _of_app("exports")]
TheSettings = Annotated[ServerSettings, _of_app("settings")]
SceneId = Annotated[str, Path(max_length=64)]


async def _scene(scenes: AllScenes, id: SceneId) -> AsyncIterator[Scene]:
    async with scenes.use(id) as scene:
        yield scene


async def _record(scenes: AllScenes, id: SceneId) -> AsyncIterator[Scene]:
    async with scenes.use(id, place=False) as scene:
        yield scene


TheScene = Annotated[Scene, Depends(_scene)]
"""Scene for routes that need its processes; the scene is woken up and takes a slot."""
TheRecord = Annotated[Scene, Depends(_record)]
"""Scene for routes that do not need its processes; it is loaded from its folder even if no slot is free."""
FrameIndex = Annotated[int, Path(ge=0, le=1_000_000_000)]
FirstFrame = Annotated[
    int | None, params.Query(alias="from", ge=0, description="First frame; the first committed frame by default.")
]
LastFrame = Annotated[
    int | None,
    params.Query(alias="to", ge=0, description="Last frame, inclusive; the last committed frame by default."),
]


def known(route: APIRoute) -> list[str]:
    """Returns the names of a route's query parameters in declaration order."""
    fields = get_flat_params(route.dependant)
    return list(dict.fromkeys(field.alias for field in fields if isinstance(field.field_info, params.Query)))


def only_known(connection: HTTPConnection) -> None:
    """Rejects unknown query parameters, so that misspelled names do not go unnoticed.

    Raises:
        Problem: 422 if a parameter is unknown; lists the valid parameters.
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
        meant = f"did you mean {near[0]!r}? " if near else ""
        there = f"the valid parameters are {', '.join(names)}" if names else "this endpoint takes no parameters"
        raise Problem(422, f"unknown parameter {name!r}", field=name, value=value, remedy=meant + there)


async def ask(request: Request, scene: Scene, query: Query) -> Answer:
    """Returns the readers' answer to a query, or cancels the query if the client disconnects.

    The request body must have been read before this call.

    Raises:
        Problem: see `Readers.ask`; 503 if the client has closed the connection.
    """
    asking, _ = await run_until_first(scene.readers.ask(query), _hung_up(request))
    if asking is None:
        raise Problem(503, "the client closed the connection", remedy="send the request again")
    answer: Answer = asking.result()
    return answer


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
