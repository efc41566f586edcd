"""Records of open connections and their peers."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Protocol

from server.connections.refusals import Refusal

PROGRESS_BYTES = 16 << 10
"""Minimum number of bytes per `body_seconds` or `unread_seconds`; slower peers are probably attackers."""


class Phase(Enum):
    """Phase of a connection."""

    NEW = auto()
    """No bytes have arrived yet; browsers open connections in advance."""
    HEAD = auto()
    """A header is arriving."""
    BODY = auto()
    """A body is arriving."""
    ANSWER = auto()
    """The request is complete, and the service is processing it."""
    IDLE = auto()
    """The connection is being kept alive between two requests."""
    LINGER = auto()
    """The response was sent before the body was complete; the rest of the body is being discarded."""
    SOCKET = auto()
    """The connection is a WebSocket, which may be idle indefinitely because pings check that its peer is alive."""
    REFUSED = auto()
    """The connection was refused, and further bytes are discarded."""


KINDS = {
    Phase.NEW: "header",
    Phase.HEAD: "header",
    Phase.BODY: "body",
    Phase.ANSWER: "answer",
    Phase.IDLE: "idle",
    Phase.LINGER: "closing",
    Phase.SOCKET: "websocket",
    Phase.REFUSED: "closing",
}
"""Value of the label `kind` of `scas4d_connections` for each phase."""


class Handler(Protocol):
    """Interface of the protocol that handles a connection."""

    @property
    def waiting_for_service(self) -> bool:
        """Whether no bytes can arrive because the service is currently not reading."""

    def refuse(self, refusal: Refusal) -> None:
        """Sends the refusal as a response, if possible, and closes the connection."""


@dataclass(eq=False, slots=True)
class OpenConnection:
    """Record of one open connection.

    Attributes:
        handler: protocol that handles the connection.
        transport: transport that carries the connection.
        peer: peer at the other end of the connection.
        since: loop time at which the phase, or its current time window, began.
        quiet_since: loop time of the last sweep that found received bytes.
        phase: current phase.
        queue: the peer's queue that contains the connection, or None.
        counted: whether the connection counts towards the limits.
        closed: whether the connection is closed.
        entered: loop time at which the phase began.
        body: body bytes received in the current window, or in all windows if the body is being discarded.
        dropped: value of `body` at the start of the current window if the body is being discarded.
        moved: whether `PROGRESS_BYTES` of the current body have arrived within a single window.
        received: bytes received since the last sweep.
        served: whether at least one request was answered.
        write_paused: whether the unsent data exceeds the high-water mark of the transport.
        unsent: bytes that the peer had not acknowledged at the last sweep.
        unsent_since: loop time at which the current window for reading these bytes began.
        sent: bytes that the peer has acknowledged in that window.
    """

    handler: Handler
    transport: asyncio.Transport
    peer: Peer
    since: float
    quiet_since: float
    phase: Phase = Phase.NEW
    queue: dict[OpenConnection, None] | None = None
    counted: bool = True
    closed: bool = False
    entered: float = 0.0
    body: int = 0
    dropped: int = 0
    moved: bool = False
    received: int = 0
    served: bool = False
    write_paused: bool = False
    unsent: int = 0
    unsent_since: float = 0.0
    sent: int = 0

    @property
    def is_begun(self) -> bool:
        """Whether no window so far has received `PROGRESS_BYTES`, or the body is being discarded."""
        return self.phase is Phase.LINGER or not self.moved

    @property
    def last_bytes_at(self) -> float:
        """Latest possible loop time at which body bytes arrived."""
        return max(self.since, self.quiet_since)


@dataclass(eq=False, slots=True)
class Peer:
    """Connections from one address; those that may be closed to make room are kept in queues, oldest first."""

    address: str
    proxy: bool
    count: int = 0
    strangers: dict[OpenConnection, None] = field(default_factory=dict)
    """Connections that have never completed a header."""
    idle: dict[OpenConnection, None] = field(default_factory=dict)
    """Connections that were served before and are idle or sending their next header."""
    bodies: dict[OpenConnection, None] = field(default_factory=dict)
    """Connections with a body that is arriving or being discarded."""
