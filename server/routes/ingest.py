"""WebSocket route for frame upload: one binary message per frame or camera image, acknowledged in order."""

from __future__ import annotations

import asyncio
import contextlib
import logging

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
from server.ingest.batch import Numbering, OnRefusal, receive_batch, refusal
from server.ingest.camera_files import receive_camera
from server.ingest.pictures import largest_frame
from server.ingest.receive import files_size, framing_problem, in_one_piece, receive_frame
from server.problems import Problem, internal_error
from server.scene.scene import Scene
from server.scene.scenes import Scenes
from server.settings import ServerSettings

router = APIRouter(prefix="/v1/scenes", tags=["frames"])

log = logging.getLogger("scas4d.server")

UNSUPPORTED = 1003
"""WebSocket close code for text messages."""
AHEAD = 1
"""Number of messages queued while one is being processed; uvicorn buffers one more."""

SMALL_BATCH = 64_000_000
"""Maximum size in bytes of a message with several frames, unless one frame of the rig can be larger."""


@router.websocket("/{id}/ingest")
async def ingest(
    socket: WebSocket, id: str, numbering: Numbering = Numbering.GIVEN, on_refusal: OnRefusal = OnRefusal.SKIP
) -> None:
    """Accepts binary messages in the `client.wire.framing` format and answers each frame with JSON text.

    A message contains one frame, one camera's files of a frame (`single_camera`, as PUT …/cameras/{c}), or a batch of
    frames (as POST …/frames). `numbering=next` in the URL gives whole frames the next indices, and
    `on_refusal=stop` ends a batch at a frame whose content is refused.

    The sender may pipeline messages: one is received while the previous one is synced to disk. Each frame is answered
    with an `IngestAnswer`, in order. A rejected frame is also answered, and the socket stays open. The handshake is
    refused if the scene does not exist (404) or has too many senders (429). A message that is larger than any possible
    frame of the rig, and larger than 64 MB, closes the connection (1009).
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
        largest = max(largest_frame(scene.rig), SMALL_BATCH)
        limit_messages(socket.scope, min(int(server.max_body_mb * 1e6), largest))
        try:
            await socket.accept()
            await _serve(socket, scenes, id, numbering, on_refusal)
        finally:
            scene.ingest.remove_socket()


async def _serve(socket: WebSocket, scenes: Scenes, id: str, numbering: Numbering, on_refusal: OnRefusal) -> None:
    """Processes messages until the sender closes the socket or sends text, or the scene becomes unavailable."""
    taking: asyncio.Queue[asyncio.Task[list[IngestAnswer]]] = asyncio.Queue(AHEAD)
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
                await socket.send_text(refusal(None, problem).model_dump_json())
                away = problem.status_code == 503
                await socket.close(SCENE_RESTARTS if away else SCENE_GONE, "the scene is not available")
                return
            head = _head(data)
            whole = isinstance(head, FrameHead) and _is_one_frame(head, data) and numbering is Numbering.GIVEN
            if not (whole and whole_before):
                await taking.join()  # the outcome of other messages and of whole frames depends on each other
            whole_before = whole
            # Tasks start in the order of the messages, so frames are accepted in that order.
            await taking.put(asyncio.create_task(_take(scene, numbering, on_refusal, head, data)))
    except WebSocketDisconnect:
        return
    finally:
        # Only answers are cancelled: a completely received frame is accepted even if its sender has disconnected.
        answering.cancel()


async def _answer(socket: WebSocket, taking: asyncio.Queue[asyncio.Task[list[IngestAnswer]]]) -> None:
    while True:
        answers = await asyncio.shield(await taking.get())
        try:
            for answer in answers:
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


def _is_one_frame(head: FrameHead, data: bytes) -> bool:
    """Returns whether a message contains one whole frame, rather than a single camera or a batch."""
    return not head.single_camera and len(data) <= PREFIX.size + head_length(data) + files_size(head)


async def _take(
    scene: Scene, numbering: Numbering, on_refusal: OnRefusal, head: FrameHead | Problem, data: bytes
) -> list[IngestAnswer]:
    if isinstance(head, Problem):
        return [refusal(None, head)]
    body, size = in_one_piece(data), len(data)
    try:
        receipt: FrameReceipt | CameraReceipt
        if head.single_camera:
            receipt = await receive_camera(scene.open_frames, None, None, body, size)
        elif numbering is Numbering.GIVEN and _is_one_frame(head, data):
            receipt = await receive_frame(scene.ingest, None, body, size)
        else:
            return (await receive_batch(scene.open_frames, numbering, on_refusal, body)).answers
        return [IngestAnswer(index=head.index, status=202, receipt=receipt)]
    except Problem as problem:
        return [refusal(head.index, problem)]
    except asyncio.CancelledError:
        raise
    except Exception as error:
        log.exception("scene %s: receiving a frame over the WebSocket failed", scene.id)
        return [refusal(head.index, internal_error(error))]
