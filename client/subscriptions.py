"""Subscriptions and events of a scene's stream, and the session state shared by the stream clients."""

from __future__ import annotations

import io
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

from client.calls.call import wire_camera
from client.calls.tracks import tracks_request
from client.errors import error_of_problem, unreachable
from client.retries import backoff
from client.wire import CameraModel, PartsModel, ProblemDetails, RenderRequest, TracksModel
from client.wire.base import Model
from client.wire.stream import (
    SERVER_MESSAGE,
    STREAM_PROTOCOL,
    BinaryHead,
    FrameMessage,
    NoRequest,
    PartsSubscription,
    SceneGone,
    SceneMessage,
    StreamProblem,
    Subscribe,
    Topic,
    Unsubscribe,
    Update,
    unpack,
)
from scas4d_core.cameras import Camera

UNREAD_MESSAGES = 2
"""Maximum number of messages to read ahead of the caller.

The limit is small because the service replaces messages that it cannot send yet with newer ones.
"""
RETRIED_STATUSES = (429, 502, 503, 504)


@dataclass(frozen=True)
class BinaryEvent:
    """Event from a binary message of a subscription.

    Attributes:
        id: subscription id.
        tag: tag of the request that caused the event.
        missed: number of unsent messages that this one replaces.
        frame: index of the newest frame that the event covers.
        media_type: media type of `body`.
        headers: response headers that the equivalent HTTP request would return.
        body: encoded content.
    """

    id: str
    tag: int | None
    missed: int
    frame: int
    media_type: str
    headers: Mapping[str, str]
    body: bytes

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns the arrays in an npz body, keyed by name; rejects pickled data."""
        with np.load(io.BytesIO(self.body), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


@dataclass(frozen=True)
class ViewEvent(BinaryEvent):
    """Event with a rendered view."""

    def picture(self) -> NDArray[Any]:
        """Returns the decoded image: [H, W, 3] uint8 for colour, otherwise [H, W]."""
        with Image.open(io.BytesIO(self.body)) as picture:
            return np.array(picture)


@dataclass(frozen=True)
class TracksEvent(BinaryEvent):
    """Event with trajectories over the frames `first` to `frame`, continuing the trajectories of the previous event."""

    first: int

    def model(self) -> TracksModel:
        """Returns the decoded trajectories; only for requests with format `json`."""
        return TracksModel.model_validate_json(self.body)


@dataclass(frozen=True)
class PartsEvent(BinaryEvent):
    """Event with the part labels of all Gaussians."""

    def model(self) -> PartsModel:
        """Returns the decoded part labels."""
        return PartsModel.model_validate_json(self.body)


@dataclass(frozen=True)
class StatesEvent(BinaryEvent):
    """Event with the newest state, as records of a compact 4D file.

    The bodies of successive events, joined, are a compact file; see `live_states`.

    Attributes:
        after: frame of the previous event, which the records continue from, or None if they start a new file.
        age: seconds from the commit of the frame to the sending of the event; None if unknown.
    """

    after: int | None
    age: float | None


Event = SceneMessage | FrameMessage | StatesEvent | ViewEvent | TracksEvent | PartsEvent


@dataclass(frozen=True)
class SubscriptionRequest:
    """Topic and request of a subscription, created by the functions below."""

    topic: Topic
    request: Model


def scene_changes() -> SubscriptionRequest:
    """Returns a subscription to the scene's state, progress and queue, sent on every change.

    >>> with Stream(url, scene) as stream:
    ...     stream.subscribe("scene", scene_changes())
    ...     event = stream.receive(timeout=20)
    >>> event.status.committed
    3
    """
    return SubscriptionRequest(Topic.SCENE, NoRequest())


def finished_frames() -> SubscriptionRequest:
    """Returns a subscription to the report of each finished frame, including its metrics.

    >>> with Stream(url, scene) as stream:
    ...     stream.subscribe("done", finished_frames())
    ...     event = stream.receive(timeout=20)
    >>> event.report.index
    2
    """
    return SubscriptionRequest(Topic.FRAMES, NoRequest())


def live_states() -> SubscriptionRequest:
    """Returns a subscription to the newest state, first as a key frame, then as changes from the previous event.

    Append the bodies to a file to read the states; if `after` is None, start a new file. Decoding requires NumPy and
    zstandard.

    >>> from scas4d_core.compact import CompactReader
    >>> with Stream(url, scene) as stream, open(f"{out}.s4d", "wb") as file:
    ...     stream.subscribe("states", live_states())
    ...     event = stream.receive(timeout=20)
    ...     written = file.write(event.body)
    >>> with CompactReader(f"{out}.s4d") as reader:
    ...     state = reader.state(event.frame)
    >>> event.after, event.frame, state.means.shape
    (None, 2, (2, 3))
    """
    return SubscriptionRequest(Topic.STATES, NoRequest())


def view(
    camera: Camera | str,
    frame: int | None = None,
    *,
    kind: str = "colour",
    format: str = "jpeg",
    background: tuple[float, float, float] | None = None,
    parts: int | None = None,
) -> SubscriptionRequest:
    """Returns a subscription to a view of every new frame or a fixed one; the arguments are as for `calls.render`.

    >>> with Stream(url, scene) as stream:
    ...     stream.subscribe("live", view(rig.cameras[0], format="png"))
    ...     event = stream.receive(timeout=20)
    >>> event.frame, event.picture().shape
    (2, (16, 24, 3))
    """
    request = {"camera": wire_camera(camera), "frame": frame, "kinds": [kind], "format": format}
    return SubscriptionRequest(
        Topic.RENDER, RenderRequest.model_validate({**request, "background": background, "parts": parts})
    )


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
) -> SubscriptionRequest:
    """Returns a subscription to trajectories, first over all existing frames, then over each new frame.

    The arguments are those of `client.calls.tracks`, except that `first` replaces `frames`.

    >>> with Stream(url, scene) as stream:
    ...     stream.subscribe("two", tracks(ids=[0, 1]))
    ...     event = stream.receive(timeout=20)
    >>> event.first, event.frame, event.model().ids
    (0, 2, [0, 1])
    """
    request = tracks_request(ids, pixels, camera, points, at, (first, None), project, format)
    return SubscriptionRequest(Topic.TRACKS, request)


def parts(count: int | None = None, *, every: int = 1) -> SubscriptionRequest:
    """Returns a subscription to the part labels of all Gaussians, recomputed every `every` frames.

    >>> with Stream(url, scene) as stream:
    ...     stream.subscribe("labels", parts(2))
    ...     event = stream.receive(timeout=20)
    >>> event.model().count
    2
    """
    return SubscriptionRequest(Topic.PARTS, PartsSubscription(count=count, every=every))


def event_of(head: BinaryHead, body: bytes) -> StatesEvent | ViewEvent | TracksEvent | PartsEvent:
    """Returns the event for a binary message."""
    given = (head.id, head.tag, head.missed, head.frame, head.media_type, head.headers, body)
    if head.type == "tracks":
        return TracksEvent(*given, first=head.frame if head.first is None else head.first)
    if head.type == "states":
        return StatesEvent(*given, after=head.after, age=head.age)
    return ViewEvent(*given) if head.type == "render" else PartsEvent(*given)


class StreamSession:
    """Session state of a stream, which stores subscriptions, builds messages to send and decodes received messages."""

    def __init__(self, url: str, scene: str, token: str | None, outage: float) -> None:
        self.scene = scene
        self.outage = outage
        base = "ws" + url.rstrip("/").removeprefix("http")
        self.address = f"{base}/v1/scenes/{quote(scene, safe='')}/stream"
        self.arguments: dict[str, Any] = {
            "subprotocols": [Subprotocol(STREAM_PROTOCOL)],
            "additional_headers": {} if token is None else {"Authorization": f"Bearer {token}"},
            "compression": None,  # large messages are already compressed
            "max_size": None,  # the client itself requested the large messages
            "max_queue": UNREAD_MESSAGES,
            "close_timeout": 2,
        }
        self.subscriptions: dict[str, Subscribe] = {}
        self._failed_at: float | None = None
        self._failures = 0

    def subscribe(self, id: str, wanted: SubscriptionRequest, tag: int | None) -> str:
        """Stores a subscription and returns the message that requests it."""
        request = wanted.request.model_dump(mode="json", exclude_unset=True)
        self.subscriptions[id] = Subscribe(id=id, topic=wanted.topic, request=request, tag=tag)
        return self.subscriptions[id].model_dump_json()

    def update(self, id: str, tag: int | None, changes: Mapping[str, Any]) -> str:
        """Changes a stored subscription and returns the message that requests the change."""
        request = dict(changes)
        if "camera" in request and not isinstance(request["camera"], str):
            request["camera"] = CameraModel.of(request["camera"]).model_dump(mode="json")
        known = self.subscriptions[id]
        self.subscriptions[id] = known.model_copy(update={"request": known.request | request, "tag": tag})
        return Update(id=id, request=request, tag=tag).model_dump_json()

    def unsubscribe(self, id: str) -> str:
        """Removes a subscription and returns the message that ends it."""
        self.subscriptions.pop(id)
        return Unsubscribe(id=id).model_dump_json()

    def read(self, data: str | bytes) -> Event | SceneGone | None:
        """Returns the event for a received message, or None if the message is irrelevant to the caller.

        Raises:
            ServiceError: the service refused a request.
        """
        if isinstance(data, bytes):
            return event_of(*unpack(data))
        message = SERVER_MESSAGE.validate_json(data)
        if isinstance(message, StreamProblem):
            raise error_of_problem(message.problem)
        return message if isinstance(message, SceneMessage | FrameMessage | SceneGone) else None

    def connected(self) -> None:
        """Resets the failure count after a successful connection."""
        self._failed_at, self._failures = None, 0

    def wait_after(self, error: Exception) -> float:
        """Returns the delay in seconds before the next connection attempt.

        Raises:
            ServiceError: the service refused the connection.
            ServiceUnreachable: the service could not be reached within the outage timeout.
        """
        if isinstance(error, InvalidStatus) and error.response.status_code not in RETRIED_STATUSES:
            raise error_of_problem(_problem(error)) from error
        now = time.monotonic()
        self._failed_at = now if self._failed_at is None else self._failed_at
        if now - self._failed_at >= self.outage:
            if isinstance(error, InvalidStatus):
                raise error_of_problem(_problem(error)) from error
            raise unreachable(self.address, error, self._failures) from error
        self._failures += 1
        return backoff(self._failures)


def _problem(error: InvalidStatus) -> ProblemDetails:
    body = error.response.body or b""
    try:
        return ProblemDetails.model_validate_json(bytes(body))
    except ValueError:
        text = bytes(body)[:200].decode("utf-8", "replace")
        return ProblemDetails(title="unexpected response", status=error.response.status_code, detail=text or str(error))
