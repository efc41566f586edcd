"""WebSocket route for frame upload: one binary message per frame or camera image, acknowledged in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from client.wire import (
    CameraReceipt,
    FrameHead,
    FrameReceipt,
    FramingError,
    IngestAnswer,
    head_length,
    parse_head,
)
from client.wire.framing import PREFIX
from client.wire.stream import SCENE_GONE, SCENE_RESTARTS
from server import problems
from server.connections.websocket import limit_messages
from server.ingest.camera_files import receive_camera
from server.ingest.pictures import largest_frame
from server.ingest.receive import framing_problem, receive_frame
from server.problems import SERVICE_FAULT, Problem
from server.scene.scene import Scene
from server.scene.scenes import Scenes
from server.settings import ServerSettings

router = APIRouter(prefix="/v1/scenes", tags=["frames"])

log = logging.getLogger("scas4d.server")

UNSUPPORTED = 1003
"""WebSocket close code for text messages."""
AHEAD = 1
"""Number of messages queued while one is being processed; uvicorn buffers one more."""


@router.websocket("/{id}/ingest")
async def ingest(socket: WebSocket, id: str) -> None:
    """Accepts binary messages in the `client.wire.framing` format and answers each with an `IngestAnswer` as text.

    The sender may pipeline messages: one is received while the previous one is synced to disk. Answers are sent in the
    order of the messages. A rejected message is also answered, and the socket stays open. A message with `part`
    corresponds to PUT …/cameras/{c}. The handshake is refused if the scene does not exist (404) or has too many senders
    (429). A message that is larger than any possible frame of the rig closes the connection (1009).
    """
    scenes: Scenes = socket.app.state.scenes
    server: ServerSettings = socket.app.state.settings
    async with contextlib.AsyncExitStack() as held:
        try:
            scene = await held.enter_async_context(scenes.use(id))
            scene.ingest.add_socket()
        except Problem as problem:  # an HTTP response refuses the handshake
            await socket.send_denial_response(problems.problem_response(problem.document, problem.headers))
            return
        limit_messages(socket.scope, min(int(server.max_body_mb * 1e6), largest_frame(scene.rig)))
        try:
            await socket.accept()
            await _serve(socket, scenes, id)
        finally:
            scene.ingest.remove_socket()


async def _serve(socket: WebSocket, scenes: Scenes, id: str) -> None:
    """Processes messages until the sender closes the socket or sends text, or the scene becomes unavailable."""
    taking: asyncio.Queue[asyncio.Task[IngestAnswer]] = asyncio.Queue(AHEAD)
    answering = asyncio.create_task(_answer(socket, taking))
    whole_before = True
    try:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            data = message.get("bytes")
            if data is None:
                await taking.join()
                await socket.close(UNSUPPORTED, "frames must be binary messages")
                return
            try:
                scene = scenes[id]
            except Problem as problem:
                await taking.join()
                await socket.send_text(_refusal(None, problem).model_dump_json())
                away = problem.status_code == 503
                await socket.close(SCENE_RESTARTS if away else SCENE_GONE, "the scene is not available")
                return
            head = _head(data)
            whole = isinstance(head, FrameHead) and not head.single_camera
            if not (whole and whole_before):
                await taking.join()  # single-camera messages and whole frames depend on each other's outcome
            whole_before = whole
            # Tasks start in the order of the messages, so frames are accepted in that order.
            await taking.put(asyncio.create_task(_take(scene, head, data)))
    except WebSocketDisconnect:
        return
    finally:
        # Only answers are cancelled: a completely received frame is accepted even if its sender has disconnected.
        answering.cancel()


async def _answer(socket: WebSocket, taking: asyncio.Queue[asyncio.Task[IngestAnswer]]) -> None:
    while True:
        answer = await asyncio.shield(await taking.get())
        try:
            await socket.send_text(answer.model_dump_json())
        except (WebSocketDisconnect, RuntimeError):  # the sender has disconnected
            pass
        finally:
            taking.task_done()


def _head(data: bytes) -> FrameHead | Problem:
    try:
        return parse_head(memoryview(data)[PREFIX.size : PREFIX.size + head_length(data)])
    except FramingError as error:
        return framing_problem(error)


async def _take(scene: Scene, head: FrameHead | Problem, data: bytes) -> IngestAnswer:
    if isinstance(head, Problem):
        return _refusal(None, head)
    body, size = _one(data), len(data)
    try:
        receipt: FrameReceipt | CameraReceipt
        if head.single_camera:
            receipt = await receive_camera(scene.open_frames, None, None, body, size)
        else:
            receipt = await receive_frame(scene.ingest, None, body, size)
        return IngestAnswer(index=head.index, status=202, receipt=receipt)
    except Problem as problem:
        return _refusal(head.index, problem)
    except asyncio.CancelledError:
        raise
    except Exception as error:
        log.exception("scene %s: receiving a frame over the WebSocket failed", scene.id)
        detail = f"internal error: {type(error).__name__}"
        return _refusal(head.index, Problem(500, detail, remedy=SERVICE_FAULT))


def _refusal(index: int | None, problem: Problem) -> IngestAnswer:
    """Returns the answer that rejects a message; `retry_after` corresponds to the Retry-After header of HTTP."""
    seconds = (problem.headers or {}).get("Retry-After")
    wait = None if seconds is None else int(seconds)
    return IngestAnswer(index=index, status=problem.status_code, retry_after=wait, problem=problem.document)


async def _one(data: bytes) -> AsyncIterator[bytes]:
    yield data
