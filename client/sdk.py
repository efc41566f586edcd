"""Typed SDK with a sync client (`Client`) and an async client (`AsyncClient`), which have the same methods.

Each method takes the arguments of the function with the same name in `client.calls` and returns the parsed response.
The retry policy is described in `client.retries`, and the exceptions in `client.errors`.
"""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from functools import wraps
from typing import Any, ParamSpec, Protocol, TypeVar, cast, overload

import httpx

from client import calls
from client.batches import SendingBatch
from client.calls import Call, NewFrame
from client.calls.frames import Numbering, OnRefusal
from client.errors import ServiceError, unexpected_response
from client.retries import BUSY_S, OUTAGE_S, OnRetry, Retries
from client.wire import FINISHED, FrameReportModel, IngestAnswer, SceneState, SceneStatus

__all__ = ["DEFAULT_URL", "AsyncClient", "Client", "ServiceError"]

P = ParamSpec("P")
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

DEFAULT_URL = "http://127.0.0.1:8000"
TIMEOUT_S = 130.0
"""Response timeout in seconds; the service itself abandons a query after 120 s."""


class _Method(Protocol[P, T_co]):
    """Method that sends a call: it returns the parsed response, or a coroutine of it in the async client."""

    @overload
    def __get__(self, client: Client, owner: Any = None) -> Callable[P, T_co]: ...
    @overload
    def __get__(self, client: AsyncClient, owner: Any = None) -> Callable[P, Coroutine[Any, Any, T_co]]: ...


def _sends(build: Callable[P, Call[T]]) -> _Method[P, T]:
    """Returns a method that sends the call that `build` returns, with the signature of `build` for `help`."""

    @wraps(build)
    def method(client: Any, /, *args: P.args, **kwargs: P.kwargs) -> Any:
        return client.send(build(*args, **kwargs))

    signature = inspect.signature(build)
    own = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    method.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[own, *signature.parameters.values()], return_annotation=inspect.Signature.empty
    )
    return cast(_Method[P, T], method)


class _ClientBase:
    """Common base class of both clients, with the URL, token and timeouts, and one method per call."""

    def __init__(
        self, url: str, token: str | None, busy_timeout: float, outage: float, on_retry: OnRetry | None
    ) -> None:
        if not url.startswith(("http://", "https://")):
            raise ValueError(f"url {url!r} is not a service URL; use http://{url.partition('://')[2] or url}")
        self.url, self.token = url.rstrip("/"), token
        self.busy_timeout, self.outage, self.on_retry = busy_timeout, outage, on_retry

    def _http_arguments(self) -> dict[str, Any]:
        headers = {} if self.token is None else {"Authorization": f"Bearer {self.token}"}
        return {"base_url": self.url, "timeout": httpx.Timeout(TIMEOUT_S, connect=10.0), "headers": headers}

    def _parse(self, call: Call[T], response: httpx.Response) -> T:
        """Returns the parsed response.

        Raises:
            ServiceError: another server responded.
        """
        try:
            return call.parse(response)
        except (ValueError, OSError) as error:  # pydantic, NumPy and Pillow
            raise unexpected_response(response) from error

    def _retries(self, call: Call[Any]) -> Retries:
        return Retries(call, self.url, busy=self.busy_timeout, outage=self.outage, on_retry=self.on_retry)

    live = _sends(calls.live)
    ready = _sends(calls.ready)
    ingest_ready = _sends(calls.ingest_ready)
    cluster = _sends(calls.cluster)
    metrics = _sends(calls.metrics)
    ticket = _sends(calls.ticket)
    share = _sends(calls.share)
    create_scene = _sends(calls.create_scene)
    estimate = _sends(calls.estimate)
    scenes = _sends(calls.scenes)
    scene = _sends(calls.scene)
    rig = _sends(calls.rig)
    pause = _sends(calls.pause)
    resume = _sends(calls.resume)
    begin_again = _sends(calls.begin_again)
    edit_scene = _sends(calls.edit_scene)
    put_to_sleep = _sends(calls.put_to_sleep)
    delete_scene = _sends(calls.delete_scene)
    put_points = _sends(calls.put_points)
    put_frame = _sends(calls.put_frame)
    put_camera = _sends(calls.put_camera)
    close_frame = _sends(calls.close_frame)
    declare_missing = _sends(calls.declare_missing)
    frame = _sends(calls.frame)
    frames = _sends(calls.frames)
    ply = _sends(calls.ply)
    states = _sends(calls.states)
    begin_export = _sends(calls.begin_export)
    exports = _sends(calls.exports)
    export = _sends(calls.export)
    export_file = _sends(calls.export_file)
    delete_export = _sends(calls.delete_export)
    picture = _sends(calls.picture)
    render = _sends(calls.render)
    render_file = _sends(calls.render_file)
    render_arrays = _sends(calls.render_arrays)
    tracks = _sends(calls.tracks)
    tracks_arrays = _sends(calls.tracks_arrays)
    parts = _sends(calls.parts)
    joints = _sends(calls.joints)
    gaussians = _sends(calls.gaussians)
    budget = _sends(calls.budget)
    set_budget = _sends(calls.set_budget)
    tradeoff = _sends(calls.tradeoff)
    replay = _sends(calls.replay)
    end_replay = _sends(calls.end_replay)


class Client(_ClientBase):
    """Synchronous, thread-safe client for the service at `url`.

    Close it after use, or use it as a context manager.

    Args:
        url: service URL.
        token: access token, if the service requires one.
        busy_timeout: maximum time in seconds that a call waits for space in a full queue (429).
        outage: maximum time in seconds that a call waits for a service that does not respond.
        on_retry: callback that receives the reason and delay before each retry.
        transport: httpx transport that replaces the network.

    Raises:
        ServiceError: the service refused a request; see `client.errors` for the subclasses.
        ServiceUnreachable: the service did not respond.

    >>> with Client(url, busy_timeout=60) as client:
    ...     new = client.create_scene(rig)
    ...     receipt = client.put_frame(new.id, 0, pictures)
    ...     report = client.wait(new.id, 0)
    ...     picture = client.render(new.id, "c0")
    ...     client.delete_scene(new.id)
    >>> report.state, picture.shape
    (<FrameState.COMMITTED: 'committed'>, (16, 24, 3))
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        token: str | None = None,
        busy_timeout: float = BUSY_S,
        outage: float = OUTAGE_S,
        on_retry: OnRetry | None = None,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        super().__init__(url, token, busy_timeout, outage, on_retry)
        self._http = httpx.Client(transport=transport, **self._http_arguments())

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connections.

        >>> client = Client(url)
        >>> client.close()
        """
        self._http.close()

    def send(self, call: Call[T]) -> T:
        """Sends a call with retries and returns its parsed response.

        >>> client.send(calls.scene(scene)).id == scene
        True
        """
        retries = self._retries(call)
        while True:
            wait: float | None
            try:
                response = self._http.request(call.method, call.path, **call.arguments)
            except httpx.TransportError as error:
                wait = retries.after_connection_error(error)
            else:
                wait = retries.after_response(response)
                if wait is None:
                    return self._parse(call, response)
            time.sleep(wait)

    def put_frames(
        self, id: str, frames: Sequence[NewFrame], numbering: Numbering = "given", on_refusal: OnRefusal = "skip"
    ) -> list[IngestAnswer]:
        """Sends a batch of frames and returns one answer per frame, in order.

        Frames for which the queue has no room are sent again. The other arguments and the errors are those of
        `calls.put_frames`.

        >>> n = client.scene(open_scene).next_frame
        >>> answers = client.put_frames(open_scene, [calls.NewFrame(n, pictures), calls.NewFrame(n + 1, pictures)])
        >>> [answer.receipt.index - n for answer in answers]
        [0, 1]
        """
        sending = SendingBatch(frames)
        while sending.left:
            batch = self.send(calls.put_frames(id, sending.left, numbering, on_refusal))
            time.sleep(sending.record(batch.answers))
        return sending.answers

    def watch(self, id: str, index: int, *, seconds: float = BUSY_S, every: float = 0.2) -> Iterator[SceneStatus]:
        """Yields the scene's status periodically until a frame is finished or the scene has failed.

        Args:
            id: scene id.
            index: frame index.
            seconds: timeout in seconds.
            every: polling interval in seconds.

        Raises:
            TimeoutError: the frame was not finished within `seconds`.

        >>> [status.committed for status in client.watch(scene, 1)]
        [3]
        """
        until = time.monotonic() + seconds
        while True:
            status = self.scene(id)
            yield status
            if _is_finished(status, self.frame(id, index)):
                return
            if time.monotonic() > until:
                raise _timeout_error(id, index, seconds)
            time.sleep(every)

    def wait(self, id: str, index: int, *, seconds: float = BUSY_S, every: float = 0.2) -> FrameReportModel:
        """Waits until a frame is committed, failed, missing or skipped, or the scene has failed; returns its report.

        Args:
            id: scene id.
            index: frame index.
            seconds: timeout in seconds.
            every: polling interval in seconds.

        Raises:
            TimeoutError: the frame was not finished within `seconds`.

        >>> client.wait(scene, 1).psnr
        31.5
        """
        for _ in self.watch(id, index, seconds=seconds, every=every):
            pass
        return self.frame(id, index)


class AsyncClient(_ClientBase):
    """Asynchronous client for the service at `url`, with the same arguments, methods and errors as `Client`.

    Methods return coroutines. Invalid arguments raise an error when the method is called, before it is awaited.

    >>> async def committed():
    ...     async with AsyncClient(url) as client:
    ...         status, report = await asyncio.gather(client.scene(scene), client.wait(scene, 1))
    ...         return status.committed, report.index
    >>> asyncio.run(committed())
    (3, 1)
    """

    def __init__(
        self,
        url: str = DEFAULT_URL,
        *,
        token: str | None = None,
        busy_timeout: float = BUSY_S,
        outage: float = OUTAGE_S,
        on_retry: OnRetry | None = None,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        super().__init__(url, token, busy_timeout, outage, on_retry)
        self._http = httpx.AsyncClient(transport=transport, **self._http_arguments())

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connections."""
        await self._http.aclose()

    async def send(self, call: Call[T]) -> T:
        """Sends a call with retries; see `Client.send`."""
        retries = self._retries(call)
        while True:
            wait: float | None
            try:
                response = await self._http.request(call.method, call.path, **call.arguments)
            except httpx.TransportError as error:
                wait = retries.after_connection_error(error)
            else:
                wait = retries.after_response(response)
                if wait is None:
                    return self._parse(call, response)
            await asyncio.sleep(wait)

    async def put_frames(
        self, id: str, frames: Sequence[NewFrame], numbering: Numbering = "given", on_refusal: OnRefusal = "skip"
    ) -> list[IngestAnswer]:
        """Sends a batch of frames and returns one answer per frame, in order.

        Frames for which the queue has no room are sent again. The other arguments and the errors are those of
        `calls.put_frames`.

        >>> n = client.scene(open_scene).next_frame
        >>> answers = client.put_frames(open_scene, [calls.NewFrame(n, pictures), calls.NewFrame(n + 1, pictures)])
        >>> [answer.receipt.index - n for answer in answers]
        [0, 1]
        """
        sending = SendingBatch(frames)
        while sending.left:
            batch = await self.send(calls.put_frames(id, sending.left, numbering, on_refusal))
            await asyncio.sleep(sending.record(batch.answers))
        return sending.answers

    async def watch(
        self, id: str, index: int, *, seconds: float = BUSY_S, every: float = 0.2
    ) -> AsyncIterator[SceneStatus]:
        """Yields the scene's status until a frame is finished; see `Client.watch`."""
        until = time.monotonic() + seconds
        while True:
            status = await self.scene(id)
            yield status
            if _is_finished(status, await self.frame(id, index)):
                return
            if time.monotonic() > until:
                raise _timeout_error(id, index, seconds)
            await asyncio.sleep(every)

    async def wait(self, id: str, index: int, *, seconds: float = BUSY_S, every: float = 0.2) -> FrameReportModel:
        """Waits until a frame is finished; see `Client.wait`."""
        async for _ in self.watch(id, index, seconds=seconds, every=every):
            pass
        return await self.frame(id, index)


def _is_finished(status: SceneStatus, frame: FrameReportModel) -> bool:
    return frame.state in FINISHED or status.state == SceneState.FAILED


def _timeout_error(id: str, index: int, seconds: float) -> TimeoutError:
    return TimeoutError(f"scene {id}: frame {index} was not finished within {seconds:g} s")
