"""Frames over a WebSocket: one binary message a frame or a camera of it, an acknowledgement each, in order."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from client.wire import FramingError, IngestAnswer, ProblemDetails, head_length, parse_head
from client.wire.framing import PREFIX
from server.door import take_camera, take_framed
from server.problems import Problem
from server.scene import Scene
from server.scenes import Scenes
from server.upload import framing_problem

router = APIRouter(prefix="/v1/scenes", tags=["frames"])

log = logging.getLogger("scas4d.server")

SCENE_GONE = 4404
UNSUPPORTED = 1003


@router.websocket("/{id}/ingest")
async def ingest(socket: WebSocket, id: str) -> None:
    """Takes binary messages as `client.wire.framing` writes them, each answered by an `IngestAnswer` as text.

    What is refused is answered and the socket stays open. The message with `part` is as PUT …/cameras/{c}.
    """
    scenes: Scenes = socket.app.state.scenes
    await socket.accept()
    try:
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            data = message.get("bytes")
            if data is None:
                await socket.close(UNSUPPORTED, "frames are binary messages")
                return
            try:
                scene = scenes[id]
            except Problem as problem:
                await socket.send_text(_refusal(None, problem.document).model_dump_json())
                await socket.close(SCENE_GONE, "the scene is not here")
                return
            answer = await _take(scene, data)
            await socket.send_text(answer.model_dump_json())
    except WebSocketDisconnect:
        return


async def _take(scene: Scene, data: bytes) -> IngestAnswer:
    index: int | None = None
    try:
        try:
            head = parse_head(memoryview(data)[PREFIX.size : PREFIX.size + head_length(data)])
        except FramingError as error:
            raise framing_problem(error) from None
        index = head.index
        take = (
            take_camera(scene, None, None, _one(data), len(data))
            if head.part
            else take_framed(scene, None, _one(data), len(data))
        )
        return IngestAnswer(index=index, status=202, receipt=await take)
    except Problem as problem:
        return _refusal(index, problem.document)
    except asyncio.CancelledError:
        raise
    except Exception as error:
        log.exception("scene %s: a frame over the WebSocket failed", scene.id)
        detail = f"the service failed: {type(error).__name__}"
        remedy = "this is a fault of the service; its log has the traceback"
        return _refusal(index, ProblemDetails(title="Internal Server Error", status=500, detail=detail, remedy=remedy))


def _refusal(index: int | None, document: ProblemDetails) -> IngestAnswer:
    return IngestAnswer(index=index, status=document.status, problem=document)


async def _one(data: bytes) -> AsyncIterator[bytes]:
    yield data
