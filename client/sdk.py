"""The typed SDK, sync (`Client`) and async (`AsyncClient`): the same methods, one `Call` each.

A call that can be repeated without harm is tried again when the connection breaks and when the service says 429 or 503,
after the time that it asks for. Frames are such calls: the service knows a frame by its content.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeVar

import httpx
import numpy as np
from numpy.typing import ArrayLike, NDArray

from client import calls
from client.calls import Call
from client.wire import (
    FrameReceipt,
    FrameReportModel,
    Health,
    PartsModel,
    PointsReceipt,
    ProblemDetails,
    SceneStatus,
    TracksModel,
)
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import InitialPoints

T = TypeVar("T")

DEFAULT_URL = "http://127.0.0.1:8000"
TIMEOUT_S = 130.0
PATIENCE_S = 3600.0
"""How long a full queue is waited for in all: a first frame takes minutes."""
BROKEN_CONNECTIONS = 5
"""Tries over a connection that breaks, with 0.2, 0.4, 0.8 … s between."""


class ServiceError(RuntimeError):
    """The service refused; `problem` says which field, which value, and what to do."""

    def __init__(self, problem: ProblemDetails) -> None:
        remedy = f" ({problem.remedy})" if problem.remedy else ""
        super().__init__(f"{problem.status}: {problem.detail}{remedy}")
        self.problem = problem


class _Retries:
    """Says after how many seconds a call may be tried again, or raises."""

    def __init__(self, call: Call[Any], patience: float) -> None:
        self.call = call
        self.patience = patience
        self.breaks = 0
        self.lost = False

    def after_break(self, error: httpx.TransportError) -> float:
        self.breaks += 1
        unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout)
        if self.breaks >= BROKEN_CONNECTIONS or not (self.call.repeatable or unsent):
            raise error
        self.lost = True
        return float(0.1 * 2**self.breaks)

    def after_answer(self, response: httpx.Response) -> float | None:
        """None: the answer stands."""
        if response.is_success or (self.call.method == "DELETE" and self.lost and response.status_code == 404):
            return None
        wait = response.headers.get("Retry-After", "")
        if self.call.repeatable and response.status_code in (429, 503) and wait.isdigit() and self.patience > 0:
            seconds = min(float(wait), self.patience)
            self.patience -= max(seconds, 0.1)
            return seconds
        try:
            problem = ProblemDetails.model_validate_json(response.content)
        except ValueError:  # not our service, or something before it
            text = response.text[:200]
            problem = ProblemDetails(title="unexpected answer", status=response.status_code, detail=text)
        raise ServiceError(problem)


class Client:
    """The service at `url`. Close it, or use it in a `with`.

    Raises:
        ServiceError: the service refused.
        httpx.TransportError: it could not be reached.
    """

    def __init__(self, url: str = DEFAULT_URL, *, patience: float = PATIENCE_S) -> None:
        self.url = url.rstrip("/")
        self.patience = patience
        self._http = httpx.Client(base_url=self.url, timeout=TIMEOUT_S)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes its connections."""
        self._http.close()

    def _send(self, call: Call[T]) -> T:
        retries = _Retries(call, self.patience)
        while True:
            wait: float | None
            try:
                response = self._http.request(call.method, call.path, **call.arguments)
            except httpx.TransportError as error:
                wait = retries.after_break(error)
            else:
                wait = retries.after_answer(response)
                if wait is None:
                    return call.parse(response)
            time.sleep(wait)

    def ready(self) -> Health:
        """Is the service up?"""
        return self._send(calls.ready())

    def create_scene(
        self,
        rig: Rig,
        *,
        name: str = "",
        preset: str = "scas4d",
        settings: Mapping[str, Any] | None = None,
        frames_per_second: float = 30.0,
    ) -> SceneStatus:
        """A new scene; `settings` is what differs from the preset, nested."""
        return self._send(
            calls.create_scene(
                rig, name=name, preset=preset, settings=settings or {}, frames_per_second=frames_per_second
            )
        )

    def scenes(self) -> list[SceneStatus]:
        """All scenes, oldest first."""
        return self._send(calls.scenes())

    def scene(self, id: str) -> SceneStatus:
        """A scene's state, progress and queue."""
        return self._send(calls.scene(id))

    def delete_scene(self, id: str) -> None:
        """Ends a scene and removes all it has on disk."""
        self._send(calls.delete_scene(id))

    def put_points(self, id: str, points: InitialPoints) -> PointsReceipt:
        """The cloud that frame 0 starts from; before frame 0."""
        return self._send(calls.put_points(id, points))

    def put_frame(
        self,
        id: str,
        index: int,
        images: Mapping[str, bytes],
        masks: Mapping[str, bytes] | None = None,
        time: float | None = None,
    ) -> FrameReceipt:
        """Sends frame `index`: the encoded files by camera name. Waits while the queue is full."""
        return self._send(calls.put_frame(id, index, images, masks, time))

    def frame(self, id: str, index: int) -> FrameReportModel:
        """What became of a frame."""
        return self._send(calls.frame(id, index))

    def render(
        self, id: str, camera: Camera | str, frame: int | None = None, *, kind: str = "colour", format: str = "png"
    ) -> NDArray[np.uint8]:
        """One kind of view as a picture: [H, W, 3] for colour, else [H, W]."""
        request = {"frame": frame, "kinds": [kind], "format": format}
        return self._send(calls.render(id, camera, request, calls.read_picture))

    def render_arrays(
        self,
        id: str,
        camera: Camera | str,
        frame: int | None = None,
        *,
        kinds: Sequence[str] = ("colour",),
        parts: int | None = None,
    ) -> dict[str, NDArray[Any]]:
        """Several kinds of view as arrays by kind: colour 0…1, depth in the rig's units, alpha, parts."""
        request = {"frame": frame, "kinds": list(kinds), "format": "npz", "parts": parts}
        return self._send(calls.render(id, camera, request, calls.read_npz))

    def tracks(
        self,
        id: str,
        *,
        ids: Sequence[int] | None = None,
        pixels: ArrayLike | None = None,
        camera: Camera | str | None = None,
        points: ArrayLike | None = None,
        at: int | None = None,
        frames: tuple[int, int] | None = None,
        project: Sequence[Camera | str] = (),
    ) -> TracksModel:
        """Trajectories of ids, of pixels [Q, 2] of `camera`, or of points [Q, 3], the latter two at frame `at`."""
        return self._send(
            calls.tracks(
                id, ids=ids, pixels=pixels, camera=camera, points=points, at=at, frames=frames, project=project
            )
        )

    def parts(self, id: str, count: int | None = None) -> PartsModel:
        """A part label for every Gaussian."""
        return self._send(calls.parts(id, count))

    def ply(self, id: str, index: int) -> bytes:
        """A committed frame as a 3DGS .ply."""
        return self._send(calls.ply(id, index))

    def wait(self, id: str, index: int, *, seconds: float = PATIENCE_S, every: float = 0.2) -> FrameReportModel:
        """Waits until a frame is committed or set aside.

        Raises:
            TimeoutError: neither within `seconds`.
        """
        for _ in self.watch(id, index, seconds=seconds, every=every):
            pass
        return self.frame(id, index)

    def watch(self, id: str, index: int, *, seconds: float = PATIENCE_S, every: float = 0.2) -> Iterator[SceneStatus]:
        """The scene's status again and again, until the frame is committed or set aside, or the scene failed."""
        until = time.monotonic() + seconds
        while True:
            status = self.scene(id)
            yield status
            if self.frame(id, index).state in ("committed", "set_aside") or status.state == "failed":
                return
            if time.monotonic() > until:
                raise TimeoutError(f"scene {id}: frame {index} was not finished within {seconds:g} s")
            time.sleep(every)


class AsyncClient:
    """The same for asyncio."""

    def __init__(self, url: str = DEFAULT_URL, *, patience: float = PATIENCE_S) -> None:
        self.url = url.rstrip("/")
        self.patience = patience
        self._http = httpx.AsyncClient(base_url=self.url, timeout=TIMEOUT_S)

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes its connections."""
        await self._http.aclose()

    async def _send(self, call: Call[T]) -> T:
        retries = _Retries(call, self.patience)
        while True:
            wait: float | None
            try:
                response = await self._http.request(call.method, call.path, **call.arguments)
            except httpx.TransportError as error:
                wait = retries.after_break(error)
            else:
                wait = retries.after_answer(response)
                if wait is None:
                    return call.parse(response)
            await asyncio.sleep(wait)

    async def ready(self) -> Health:
        """As `Client.ready`."""
        return await self._send(calls.ready())

    async def create_scene(
        self,
        rig: Rig,
        *,
        name: str = "",
        preset: str = "scas4d",
        settings: Mapping[str, Any] | None = None,
        frames_per_second: float = 30.0,
    ) -> SceneStatus:
        """As `Client.create_scene`."""
        return await self._send(
            calls.create_scene(
                rig, name=name, preset=preset, settings=settings or {}, frames_per_second=frames_per_second
            )
        )

    async def scenes(self) -> list[SceneStatus]:
        """As `Client.scenes`."""
        return await self._send(calls.scenes())

    async def scene(self, id: str) -> SceneStatus:
        """As `Client.scene`."""
        return await self._send(calls.scene(id))

    async def delete_scene(self, id: str) -> None:
        """As `Client.delete_scene`."""
        await self._send(calls.delete_scene(id))

    async def put_points(self, id: str, points: InitialPoints) -> PointsReceipt:
        """As `Client.put_points`."""
        return await self._send(calls.put_points(id, points))

    async def put_frame(
        self,
        id: str,
        index: int,
        images: Mapping[str, bytes],
        masks: Mapping[str, bytes] | None = None,
        time: float | None = None,
    ) -> FrameReceipt:
        """As `Client.put_frame`."""
        return await self._send(calls.put_frame(id, index, images, masks, time))

    async def frame(self, id: str, index: int) -> FrameReportModel:
        """As `Client.frame`."""
        return await self._send(calls.frame(id, index))

    async def render(
        self, id: str, camera: Camera | str, frame: int | None = None, *, kind: str = "colour", format: str = "png"
    ) -> NDArray[np.uint8]:
        """As `Client.render`."""
        request = {"frame": frame, "kinds": [kind], "format": format}
        return await self._send(calls.render(id, camera, request, calls.read_picture))

    async def render_arrays(
        self,
        id: str,
        camera: Camera | str,
        frame: int | None = None,
        *,
        kinds: Sequence[str] = ("colour",),
        parts: int | None = None,
    ) -> dict[str, NDArray[Any]]:
        """As `Client.render_arrays`."""
        request = {"frame": frame, "kinds": list(kinds), "format": "npz", "parts": parts}
        return await self._send(calls.render(id, camera, request, calls.read_npz))

    async def tracks(
        self,
        id: str,
        *,
        ids: Sequence[int] | None = None,
        pixels: ArrayLike | None = None,
        camera: Camera | str | None = None,
        points: ArrayLike | None = None,
        at: int | None = None,
        frames: tuple[int, int] | None = None,
        project: Sequence[Camera | str] = (),
    ) -> TracksModel:
        """As `Client.tracks`."""
        return await self._send(
            calls.tracks(
                id, ids=ids, pixels=pixels, camera=camera, points=points, at=at, frames=frames, project=project
            )
        )

    async def parts(self, id: str, count: int | None = None) -> PartsModel:
        """As `Client.parts`."""
        return await self._send(calls.parts(id, count))

    async def ply(self, id: str, index: int) -> bytes:
        """As `Client.ply`."""
        return await self._send(calls.ply(id, index))
