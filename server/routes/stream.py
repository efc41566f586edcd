"""WebSocket route for subscriptions with the protocol `scas4d.stream.v1` (docs/stream.md)."""

from __future__ import annotations

import contextlib
import logging
import time

from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect, WebSocketState

from client.wire.stream import STREAM_PROTOCOL, TOO_BIG
from server import problems
from server.background import run_until_first
from server.connections.websocket import limit_messages
from server.http.permissions import ALL, PERMISSION
from server.hub import Hub
from server.problems import Problem
from server.scene.scenes import Scenes
from server.stream.subscriber import Subscriber

router = APIRouter(prefix="/v1/scenes")

log = logging.getLogger("scas4d.server")


@router.websocket("/{id}/stream")
async def stream(websocket: WebSocket, id: str) -> None:
    """Streams the client's subscriptions: scene state, finished frames, live states, views, tracks and parts."""
    scenes: Scenes = websocket.app.state.scenes
    hub: Hub = websocket.app.state.hub
    async with contextlib.AsyncExitStack() as held:
        try:
            scene = await held.enter_async_context(scenes.use(id))
            _require_protocol(websocket)
            subscriber = hub.join(id, scene.readers.ask, lambda channel: Subscriber(scene, channel))
        except Problem as problem:  # an HTTP response refuses the handshake; browsers see only the failure
            await websocket.send_denial_response(problems.problem_response(problem.document, problem.headers))
            return
        limit_messages(websocket.scope, 4 * subscriber.limits().message_bytes)  # `_read` enforces the exact limit
        try:
            await websocket.accept(subprotocol=STREAM_PROTOCOL)
            await _serve(websocket, subscriber, websocket.scope.get(PERMISSION, ALL).end)
        finally:
            hub.leave(id, subscriber)
            subscriber.close()


def _require_protocol(websocket: WebSocket) -> None:
    offered = websocket.scope["subprotocols"]
    if STREAM_PROTOCOL not in offered:
        raise Problem(
            400,
            "the client offers no supported subprotocol",
            field="Sec-WebSocket-Protocol",
            value=", ".join(name for name in offered if not name.startswith("scas4d.ticket.")),
            remedy=f"offer {STREAM_PROTOCOL}",
        )


async def _serve(websocket: WebSocket, subscriber: Subscriber, end: float | None) -> None:
    """Serves the connection until the client or the service closes it, or the client's permission expires."""
    await subscriber.greet()
    seconds = None if end is None else max(0.0, end - time.time())
    tasks = await run_until_first(_read(websocket, subscriber), _write(websocket, subscriber), seconds=seconds)
    ended = [task for task in tasks if task is not None]
    if not ended:
        await websocket.close(1008, "the link has expired")
    for task in ended:
        if (error := task.exception()) is not None and not isinstance(error, WebSocketDisconnect):
            log.error("scene %s: a stream failed", subscriber.scene.id, exc_info=error)


async def _read(websocket: WebSocket, subscriber: Subscriber) -> None:
    limit = subscriber.limits().message_bytes
    while True:
        message = await websocket.receive()
        if message["type"] == "websocket.disconnect":
            return
        text = message.get("text")
        if text is not None and len(text) > limit:  # characters, each up to four bytes in UTF-8
            await websocket.close(TOO_BIG, f"a message of {len(text)} characters exceeds the limit of {limit} bytes")
            return
        await subscriber.handle_message(text)


async def _write(websocket: WebSocket, subscriber: Subscriber) -> None:
    async def send(message: str | bytes) -> None:
        if isinstance(message, str):
            await websocket.send_text(message)
        else:
            await websocket.send_bytes(message)

    await subscriber.outbox.send_all(send)
    if websocket.application_state == WebSocketState.CONNECTED:
        with contextlib.suppress(RuntimeError):
            await websocket.close(*subscriber.closing)
