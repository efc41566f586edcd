"""Wire models of the stream protocol `scas4d.stream.v1` (docs/stream.md).

Clients send text messages (`ClientMessage`). The service sends text messages, and binary messages for bulk data. A
binary message consists of the magic `S4DS`, the header length as little-endian uint32, a JSON header, and the data.
"""

from __future__ import annotations

import struct
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter

from client.wire.base import Model
from client.wire.frames import FrameReportModel
from client.wire.scenes import SceneStatus
from client.wire.service import ProblemDetails
from client.wire.tracks import TracksRequest
from client.wire.views import RenderRequest

STREAM_PROTOCOL = "scas4d.stream.v1"
"""Name of the WebSocket subprotocol; it includes the protocol version."""

MAGIC = b"S4DS"
_PREFIX = struct.Struct("<4sI")

SCENE_GONE = 4404
"""Close code: the scene was deleted."""
SCENE_RESTARTS = 1012
"""Close code: the scene's reconstruction or the service is restarting, and the client should reconnect."""
TOO_BIG = 1009
"""Close code: a message was larger than `StreamLimits.message_bytes`."""

SubscriptionId = Annotated[
    str, Field(min_length=1, max_length=64, description="Name of the subscription, chosen by the client.")
]
Tag = Annotated[
    int | None,
    Field(default=None, ge=0, le=2**53 - 1, description="Number that is echoed in every message for this request."),
]


class Topic(StrEnum):
    """The topic of a subscription."""

    SCENE = "scene"
    FRAMES = "frames"
    STATES = "states"
    RENDER = "render"
    TRACKS = "tracks"
    PARTS = "parts"


class NoRequest(Model):
    """The empty request of topics without options."""


class PartsSubscription(Model):
    """A subscription to part labels."""

    count: int | None = Field(default=None, ge=1, le=254)
    """Number of parts; default: chosen automatically."""
    every: int = Field(default=1, ge=1, le=1_000_000)
    """Number of frames between messages. Finding the parts keeps the reader busy for a while."""


REQUESTS: dict[Topic, type[Model]] = {
    Topic.SCENE: NoRequest,
    Topic.FRAMES: NoRequest,
    Topic.STATES: NoRequest,
    Topic.RENDER: RenderRequest,
    Topic.TRACKS: TracksRequest,
    Topic.PARTS: PartsSubscription,
}
"""Request model of each topic. A render request with a null `frame` follows the newest frame."""


# Messages from the client.


class Subscribe(Model):
    """Starts a subscription, replacing any subscription with the same id."""

    type: Literal["subscribe"] = "subscribe"
    id: SubscriptionId
    topic: Topic
    request: dict[str, Any] = Field(default_factory=dict)
    tag: Tag = None


class Update(Model):
    """Changes some fields of a subscription's request, for example when the camera moves."""

    type: Literal["update"] = "update"
    id: SubscriptionId
    request: dict[str, Any] = Field(default_factory=dict)
    tag: Tag = None


class Unsubscribe(Model):
    """Ends a subscription."""

    type: Literal["unsubscribe"] = "unsubscribe"
    id: SubscriptionId


ClientMessage = Annotated[Subscribe | Update | Unsubscribe, Field(discriminator="type")]
CLIENT_MESSAGE: TypeAdapter[Subscribe | Update | Unsubscribe] = TypeAdapter(ClientMessage)


# Text messages from the service.


class StreamLimits(Model):
    """The service's limits for one client."""

    subscriptions: int
    """Maximum number of subscriptions."""
    message_bytes: int
    """Maximum size of a client message in bytes."""
    render_pixels: int
    """Maximum number of pixels per view."""
    track_points: int
    """Maximum number of points × frames per tracks message."""


class Hello(Model):
    """The first message from the service."""

    type: Literal["hello"] = "hello"
    protocol: str
    scene: str
    limits: StreamLimits


class Subscribed(Model):
    """Confirms a `subscribe`."""

    type: Literal["subscribed"] = "subscribed"
    id: SubscriptionId


class Unsubscribed(Model):
    """Confirms an `unsubscribe`; no more messages with this id follow."""

    type: Literal["unsubscribed"] = "unsubscribed"
    id: SubscriptionId


class StreamProblem(Model):
    """Reports a rejected request or update. If it has an id, that subscription remains active."""

    type: Literal["error"] = "error"
    id: SubscriptionId | None = None
    tag: Tag = None
    problem: ProblemDetails


class SceneMessage(Model):
    """The current status of the scene."""

    type: Literal["scene"] = "scene"
    id: SubscriptionId
    missed: int
    """Number of unsent status changes that this message replaces."""
    status: SceneStatus


class FrameMessage(Model):
    """The report of a finished frame: its metrics, or the reason why it was not committed."""

    type: Literal["frame"] = "frame"
    id: SubscriptionId
    missed: int
    """Number of unsent frame reports that this message replaces."""
    report: FrameReportModel


class SceneGone(Model):
    """Reports that the scene was deleted; the service then closes the WebSocket with code 4404."""

    type: Literal["gone"] = "gone"
    reason: str


ServerMessage = Annotated[
    Hello | Subscribed | Unsubscribed | StreamProblem | SceneMessage | FrameMessage | SceneGone,
    Field(discriminator="type"),
]
SERVER_MESSAGE: TypeAdapter[
    Hello | Subscribed | Unsubscribed | StreamProblem | SceneMessage | FrameMessage | SceneGone
] = TypeAdapter(ServerMessage)


# Headers of binary messages from the service.


class BinaryHead(Model):
    """The header of a binary message, which describes the data that follows."""

    type: Literal["states", "render", "tracks", "parts"]
    id: SubscriptionId
    tag: Tag = None
    missed: int
    """Number of unsent messages, for earlier frames or camera positions, that this one replaces."""
    frame: int
    """Frame of the state or view, last frame of the tracks, or newest frame of the parts."""
    first: int | None = None
    """Tracks only: first frame in the message; earlier frames were already sent."""
    after: int | None = None
    """States only: frame that the records continue from; absent if they start a new compact file."""
    age: float | None = None
    """States only: seconds from the commit to the sending of this message, if known."""
    media_type: str
    """Media type of the body, as for the same request over HTTP."""
    headers: dict[str, str] = Field(default_factory=dict)
    """HTTP response headers with lowercase names, e.g. x-depth-near."""


def pack(head: Model, body: bytes) -> bytes:
    """Builds a binary message from its header and body."""
    text = head.model_dump_json(exclude_none=True).encode()
    return b"".join((_PREFIX.pack(MAGIC, len(text)), text, body))


def unpack(message: bytes) -> tuple[BinaryHead, bytes]:
    """Splits a binary message into its header and body.

    Raises:
        ValueError: the message is not in this format.
    """
    if len(message) < _PREFIX.size:
        raise ValueError(f"a binary message of {len(message)} bytes is too short for its header")
    magic, length = _PREFIX.unpack_from(message)
    if magic != MAGIC or _PREFIX.size + length > len(message):
        raise ValueError(f"invalid binary message of {len(message)} bytes: magic {magic!r}, header of {length} bytes")
    head = BinaryHead.model_validate_json(message[_PREFIX.size : _PREFIX.size + length])
    return head, message[_PREFIX.size + length :]
