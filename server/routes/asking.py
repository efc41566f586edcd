"""Questions to a scene's readers on behalf of a request: one whose asker has hung up is taken back."""

from __future__ import annotations

import asyncio
import contextlib

from fastapi import Request

from server.problems import Problem
from server.processes.messages import Answer, Query
from server.scene.scenes import Scene


async def ask(request: Request, scene: Scene, query: Query) -> Answer:
    """The readers' answer; the request's body has been read.

    Raises:
        Problem: as `Readers.ask`; 503 where nobody is left to read the answer.
    """
    asking = asyncio.ensure_future(scene.ask(query))
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
    raise Problem(503, "whoever asked has hung up", remedy="ask again")


async def _hung_up(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
