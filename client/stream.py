"""Sync (`Stream`) and async (`AsyncStream`) clients for a scene's live stream; docs/stream.md describes the protocol.

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

If the connection is lost, the client reconnects and renews all subscriptions, so that a stream survives a restart of
the service. Trajectories are then sent again from their first frame. Iteration ends when the scene is deleted.
"""

from __future__ import annotations

import asyncio
import time
from contextlib import ExitStack
from typing import Any

from websockets.asyncio.client import ClientConnection as AsyncConnection
from websockets.asyncio.client import connect as connect_async
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as connect_sync

from client.retries import OUTAGE_S
from client.subscriptions import (  # noqa: F401 (public names of this module)
    Event,
    PartsEvent,
    StatesEvent,
    StreamSession,
    SubscriptionRequest,
    TracksEvent,
    ViewEvent,
    finished_frames,
    live_states,
    parts,
    scene_changes,
    tracks,
    view,
)
from client.wire.stream import (  # noqa: F401 (public names of this module)
    SCENE_GONE,
    FrameMessage,
    SceneGone,
    SceneMessage,
)

CONNECTION_ERRORS = (OSError, ConnectionClosed, InvalidHandshake, EOFError)


class Stream:
    """Live stream of a scene, used as a context manager and an iterator over events.

    `subscribe`, `update` and `unsubscribe` may be called from a thread other than the one that iterates. Iteration
    can continue after a `ServiceError`.

    Args:
        url: service URL, http or https.
        scene: scene id.
        token: access token, if the service requires one.
        outage: maximum time in seconds to wait for a service that does not respond.

    Raises:
        ServiceError: the service refused a request; `NotFound` if the scene does not exist.
        ServiceUnreachable: the service did not respond.

    >>> with Stream(url, scene) as stream:
    ...     stream.subscribe("live", view("c0"), tag=1)
    ...     event = stream.receive(timeout=20)
    ...     stream.update("live", frame=0, tag=2)
    ...     stream.unsubscribe("live")
    >>> event.id, event.tag, event.frame, event.picture().shape
    ('live', 1, 2, (16, 24, 3))
    """

    def __init__(self, url: str, scene: str, *, token: str | None = None, outage: float = OUTAGE_S) -> None:
        self._session = StreamSession(url, scene, token, outage)
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

    def subscribe(self, id: str, wanted: SubscriptionRequest, *, tag: int | None = None) -> None:
        """Starts a subscription with an id of your choice; `tag` is echoed in its events."""
        self._send(self._session.subscribe(id, wanted, tag))

    def update(self, id: str, *, tag: int | None = None, **request: Any) -> None:
        """Changes fields of a subscription's request, such as `camera` and `frame` of a view."""
        self._send(self._session.update(id, tag, request))

    def unsubscribe(self, id: str) -> None:
        """Ends a subscription."""
        self._send(self._session.unsubscribe(id))

    def receive(self, timeout: float | None = None) -> Event | None:
        """Returns the next event, or None if the scene was deleted.

        Raises:
            TimeoutError: no event arrived within `timeout` seconds.
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
            if isinstance(event, SceneGone):
                return None
            if event is not None:
                return event

    def _connect(self) -> ClientConnection:
        session = self._session
        while True:
            try:
                # Used as a context manager, because the return type of `connect` differs between versions.
                connection: ClientConnection = self._open.enter_context(
                    connect_sync(session.address, **session.arguments)
                )
                for subscription in session.subscriptions.values():
                    connection.send(subscription.model_dump_json())
            except CONNECTION_ERRORS as error:
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
            pass  # the receiver reconnects and renews its subscriptions


class AsyncStream:
    """Live stream of a scene for asyncio, used as an async context manager and an async iterator over events.

    >>> async def newest():
    ...     async with AsyncStream(url, scene) as stream:
    ...         await stream.subscribe("labels", parts(2))
    ...         return await stream.receive()
    >>> asyncio.run(newest()).model().count
    2
    """

    def __init__(self, url: str, scene: str, *, token: str | None = None, outage: float = OUTAGE_S) -> None:
        self._session = StreamSession(url, scene, token, outage)
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

    async def subscribe(self, id: str, wanted: SubscriptionRequest, *, tag: int | None = None) -> None:
        """Starts a subscription; see `Stream.subscribe`."""
        await self._send(self._session.subscribe(id, wanted, tag))

    async def update(self, id: str, *, tag: int | None = None, **request: Any) -> None:
        """Changes fields of a subscription's request; see `Stream.update`."""
        await self._send(self._session.update(id, tag, request))

    async def unsubscribe(self, id: str) -> None:
        """Ends a subscription; see `Stream.unsubscribe`."""
        await self._send(self._session.unsubscribe(id))

    async def receive(self) -> Event | None:
        """Returns the next event, or None if the scene was deleted."""
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
            if isinstance(event, SceneGone):
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
            except CONNECTION_ERRORS as error:
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
            pass  # see `Stream._send`
