"""Subscriptions to a scene, sync (`Stream`) and async (`AsyncStream`): what docs/stream.md describes, typed.

::

    with Stream(url, scene) as stream:
        stream.subscribe("done", finished_frames())
        stream.subscribe("live", view(camera, format="jpeg"))
        for event in stream:
            match event:
                case FrameMessage(report=report):
                    print(report.index, report.psnr)
                case ViewEvent():
                    show(event.picture())
                    stream.update("live", camera=next_camera())

A connection that breaks is made anew and everything is subscribed to again, so that a stream outlives a restart of the
service; trajectories are then sent from their first frame. The iteration ends when the scene is deleted.
"""

from __future__ import annotations

import asyncio
import io
import random
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from websockets.asyncio.client import ClientConnection as AsyncConnection
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as connect_sync
from websockets.typing import Subprotocol

from client.errors import ServiceUnreachable, error_of_problem
from client.wire import CameraModel, PartsModel, ProblemDetails, RenderRequest, TracksModel, TracksRequest
from client.wire.base import Model
from client.wire.stream import (
    SCENE_GONE,
    SERVER_MESSAGE,
    STREAM_PROTOCOL,
    BulkHead,
    FrameMessage,
    Gone,
    NoRequest,
    PartsSubscription,
    SceneMessage,
    StreamProblem,
    Subscribe,
    Topic,
    Unsubscribe,
    Update,
    unpack,
)
from scas4d_core.cameras import Camera

OUTAGE_S = 20.0
FIRST_WAIT_S = 0.2
LONGEST_WAIT_S = 5.0
UNREAD_MESSAGES = 2
"""Read ahead of the caller. Few: what the service holds back is replaced by what is newer."""
RETRIED_STATUSES = (429, 502, 503, 504)


@dataclass(frozen=True)
class Bulk:
    """Bytes that came for a subscription.

    Attributes:
        id: the subscription's. tag: of the request that this answers. missed: what it took the place of, unsent.
        frame: the newest that it knows. media_type: of `body`. headers: as the same request over HTTP has them.
    """

    id: str
    tag: int | None
    missed: int
    frame: int
    media_type: str
    headers: Mapping[str, str]
    body: bytes

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The body of an npz; nothing is unpickled."""
        with np.load(io.BytesIO(self.body), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


@dataclass(frozen=True)
class ViewEvent(Bulk):
    """A view."""

    def picture(self) -> NDArray[Any]:
        """[H, W, 3] uint8 for colour, else [H, W]."""
        with Image.open(io.BytesIO(self.body)) as picture:
            return np.array(picture)


@dataclass(frozen=True)
class TracksEvent(Bulk):
    """Trajectories over the frames `first` to `frame`, which go on where the message before ended."""

    first: int

    def model(self) -> TracksModel:
        """Of a request for JSON."""
        return TracksModel.model_validate_json(self.body)


@dataclass(frozen=True)
class PartsEvent(Bulk):
    """Labels."""

    def model(self) -> PartsModel:
        """Of a request for JSON."""
        return PartsModel.model_validate_json(self.body)


Event = SceneMessage | FrameMessage | ViewEvent | TracksEvent | PartsEvent


@dataclass(frozen=True)
class Wish:
    """A topic and its request, to subscribe to; made by the functions below."""

    topic: Topic
    request: Model


def scene_changes() -> Wish:
    """State, progress and queue at every change."""
    return Wish(Topic.SCENE, NoRequest())


def finished_frames() -> Wish:
    """Subscribes to the report of each finished frame, with its metrics."""
    return Wish(Topic.FRAMES, NoRequest())


def view(
    camera: Camera | str,
    frame: int | None = None,
    *,
    kind: str = "colour",
    format: str = "jpeg",
    background: tuple[float, float, float] | None = None,
    parts: int | None = None,
) -> Wish:
    """A view of every new frame, or of a chosen one; `Stream.update` moves the camera. As `client.calls.render`."""
    request = {"camera": _wire(camera), "frame": frame, "kinds": [kind], "format": format}
    return Wish(Topic.RENDER, RenderRequest.model_validate({**request, "background": background, "parts": parts}))


def tracks(
    *,
    ids: Sequence[int] | None = None,
    pixels: ArrayLike | None = None,
    camera: Camera | str | None = None,
    points: ArrayLike | None = None,
    at: int | None = None,
    first: int | None = None,
    project: Sequence[Camera | str] = (),
    format: str = "json",
) -> Wish:
    """Trajectories so far, then those of each new frame. As `client.calls.tracks`."""
    request = {
        "ids": None if ids is None else [int(id) for id in ids],
        "pixels": None if pixels is None else np.asarray(pixels, dtype=np.float64).tolist(),
        "camera": None if camera is None else _wire(camera),
        "points": None if points is None else np.asarray(points, dtype=np.float64).tolist(),
        "at": at,
        "first": first,
        "project": [_wire(one) for one in project],
        "format": format,
    }
    return Wish(Topic.TRACKS, TracksRequest.model_validate(request))


def parts(count: int | None = None, *, every: int = 1) -> Wish:
    """Labels of all Gaussians, found anew when `every` more frames are there."""
    return Wish(Topic.PARTS, PartsSubscription(count=count, every=every))


def _wire(camera: Camera | str) -> CameraModel | str:
    return camera if isinstance(camera, str) else CameraModel.of(camera)


class _Session:
    """Subscriptions of a stream, the messages that ask for them, and the events read from the answers."""

    def __init__(self, url: str, scene: str, token: str | None, outage: float) -> None:
        self.scene = scene
        self.outage = outage
        base = "ws" + url.rstrip("/").removeprefix("http")
        self.address = f"{base}/v1/scenes/{quote(scene, safe='')}/stream"
        self.arguments: dict[str, Any] = {
            "subprotocols": [Subprotocol(STREAM_PROTOCOL)],
            "additional_headers": {} if token is None else {"Authorization": f"Bearer {token}"},
            "compression": None,  # bulk is compressed already
            "max_size": None,  # the service is the one that was asked for bulk
            "max_queue": UNREAD_MESSAGES,
            "close_timeout": 2,
        }
        self.subscriptions: dict[str, Subscribe] = {}
        self._failed_at: float | None = None
        self._failures = 0

    def subscribe(self, id: str, wish: Wish, tag: int | None) -> str:
        request = wish.request.model_dump(mode="json", exclude_unset=True)
        self.subscriptions[id] = Subscribe(id=id, topic=wish.topic, request=request, tag=tag)
        return self.subscriptions[id].model_dump_json()

    def update(self, id: str, tag: int | None, changes: Mapping[str, Any]) -> str:
        request = dict(changes)
        if "camera" in request and not isinstance(request["camera"], str):
            request["camera"] = CameraModel.of(request["camera"]).model_dump(mode="json")
        known = self.subscriptions[id]
        self.subscriptions[id] = known.model_copy(update={"request": known.request | request, "tag": tag})
        return Update(id=id, request=request, tag=tag).model_dump_json()

    def unsubscribe(self, id: str) -> str:
        self.subscriptions.pop(id)
        return Unsubscribe(id=id).model_dump_json()

    def read(self, data: str | bytes) -> Event | Gone | None:
        """The event of a message; None for a message that is none to the caller.

        Raises:
            ServiceError: the service refused what was asked for.
        """
        if isinstance(data, bytes):
            return _event(*unpack(data))
        message = SERVER_MESSAGE.validate_json(data)
        if isinstance(message, StreamProblem):
            raise error_of_problem(message.problem)
        return message if isinstance(message, SceneMessage | FrameMessage | Gone) else None

    def connected(self) -> None:
        self._failed_at, self._failures = None, 0

    def wait_after(self, error: Exception) -> float:
        """Seconds until the next try.

        Raises:
            ServiceError: the service answered, and refused.
            ServiceUnreachable: it was tried for long enough.
        """
        if isinstance(error, InvalidStatus) and error.response.status_code not in RETRIED_STATUSES:
            raise error_of_problem(_problem(error)) from error
        now = time.monotonic()
        self._failed_at = now if self._failed_at is None else self._failed_at
        if now - self._failed_at >= self.outage:
            if isinstance(error, InvalidStatus):
                raise error_of_problem(_problem(error)) from error
            raise ServiceUnreachable(f"{self.address} cannot be reached: {error}") from error
        self._failures += 1
        grown = min(LONGEST_WAIT_S, FIRST_WAIT_S * 2.0 ** min(self._failures - 1, 16))
        return grown * random.uniform(0.5, 1.0)


def _event(head: BulkHead, body: bytes) -> ViewEvent | TracksEvent | PartsEvent:
    given = (head.id, head.tag, head.missed, head.frame, head.media_type, head.headers, body)
    if head.type == "tracks":
        return TracksEvent(*given, first=head.frame if head.first is None else head.first)
    return ViewEvent(*given) if head.type == "render" else PartsEvent(*given)


def _problem(error: InvalidStatus) -> ProblemDetails:
    body = error.response.body or b""
    try:
        return ProblemDetails.model_validate_json(bytes(body))
    except ValueError:
        text = bytes(body)[:200].decode("utf-8", "replace")
        return ProblemDetails(title="unexpected answer", status=error.response.status_code, detail=text or str(error))


BROKEN = (OSError, ConnectionClosed, InvalidHandshake, EOFError)


class Stream:
    """A scene's stream. Use it in a `with`; iterate over it for events.

    `subscribe`, `update` and `unsubscribe` may be called from another thread than the one that iterates. After a
    `ServiceError` the iteration can go on.

    Args:
        url: of the service, http or https. scene: its id. token: of a service that asks for one.
        outage: seconds that a service that does not answer is waited for.

    Raises:
        ServiceError: the service refused; `NotFound` where there is no such scene.
        ServiceUnreachable: nobody answered.
    """

    def __init__(self, url: str, scene: str, *, token: str | None = None, outage: float = OUTAGE_S) -> None:
        self._session = _Session(url, scene, token, outage)
        self._connection: ClientConnection | None = None
        self._open = ExitStack()

    def __enter__(self) -> Stream:
        self._connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __iter__(self) -> Stream:
        return self

    def __next__(self) -> Event:
        event = self.receive()
        if event is None:
            raise StopIteration
        return event

    def close(self) -> None:
        """Closes the connection."""
        self._connection = None
        self._open.close()

    def subscribe(self, id: str, wish: Wish, *, tag: int | None = None) -> None:
        """Begins a subscription under a name of yours; `tag` comes back with what is sent for it."""
        self._send(self._session.subscribe(id, wish, tag))

    def update(self, id: str, *, tag: int | None = None, **request: Any) -> None:
        """Changes members of a subscription's request, such as `camera` and `frame` of a view."""
        self._send(self._session.update(id, tag, request))

    def unsubscribe(self, id: str) -> None:
        """Ends a subscription."""
        self._send(self._session.unsubscribe(id))

    def receive(self, timeout: float | None = None) -> Event | None:
        """The next event; None when the scene was deleted.

        Raises:
            TimeoutError: none within `timeout` seconds.
        """
        until = None if timeout is None else time.monotonic() + timeout
        while True:
            connection = self._connection or self._connect()
            try:
                data = connection.recv(None if until is None else max(0.0, until - time.monotonic()))
            except ConnectionClosed as error:
                self.close()
                if error.rcvd is not None and error.rcvd.code == SCENE_GONE:
                    return None
                continue
            event = self._session.read(data)
            if isinstance(event, Gone):
                return None
            if event is not None:
                return event

    def _connect(self) -> ClientConnection:
        session = self._session
        while True:
            try:
                # As a context: what `connect` returns differs between versions, what it yields does not.
                connection: ClientConnection = self._open.enter_context(
                    connect_sync(session.address, **session.arguments)
                )
                for subscription in session.subscriptions.values():
                    connection.send(subscription.model_dump_json())
            except BROKEN as error:
                time.sleep(session.wait_after(error))
                continue
            session.connected()
            self._connection = connection
            return connection

    def _send(self, message: str) -> None:
        try:
            if self._connection is not None:
                self._connection.send(message)
        except ConnectionClosed:
            pass  # whoever receives connects anew, and says what is subscribed to then


class AsyncStream:
    """The same for asyncio: `async with`, `async for`."""

    def __init__(self, url: str, scene: str, *, token: str | None = None, outage: float = OUTAGE_S) -> None:
        self._session = _Session(url, scene, token, outage)
        self._connection: AsyncConnection | None = None

    async def __aenter__(self) -> AsyncStream:
        await self._connect()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    def __aiter__(self) -> AsyncStream:
        return self

    async def __anext__(self) -> Event:
        event = await self.receive()
        if event is None:
            raise StopAsyncIteration
        return event

    async def close(self) -> None:
        """Closes the connection."""
        if self._connection is not None:
            await self._connection.close()

    async def subscribe(self, id: str, wish: Wish, *, tag: int | None = None) -> None:
        """As `Stream.subscribe`."""
        await self._send(self._session.subscribe(id, wish, tag))

    async def update(self, id: str, *, tag: int | None = None, **request: Any) -> None:
        """As `Stream.update`."""
        await self._send(self._session.update(id, tag, request))

    async def unsubscribe(self, id: str) -> None:
        """As `Stream.unsubscribe`."""
        await self._send(self._session.unsubscribe(id))

    async def receive(self) -> Event | None:
        """The next event; None when the scene was deleted."""
        while True:
            connection = self._connection or await self._connect()
            try:
                data = await connection.recv()
            except ConnectionClosed as error:
                self._connection = None
                if error.rcvd is not None and error.rcvd.code == SCENE_GONE:
                    return None
                continue
            event = self._session.read(data)
            if isinstance(event, Gone):
                return None
            if event is not None:
                return event

    async def _connect(self) -> AsyncConnection:
        session = self._session
        while True:
            try:
                connection = await connect_async(session.address, **session.arguments)
                for subscription in session.subscriptions.values():
                    await connection.send(subscription.model_dump_json())
            except BROKEN as error:
                await asyncio.sleep(session.wait_after(error))
                continue
            session.connected()
            self._connection = connection
            return connection

    async def _send(self, message: str) -> None:
        try:
            if self._connection is not None:
                await self._connection.send(message)
        except ConnectionClosed:
            pass  # as in `Stream`
