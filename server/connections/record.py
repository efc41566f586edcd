"""Records of open connections, and of the peers that hold them."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Protocol

from server.connections.refusals import Refusal

PROGRESS_BYTES = 16 << 10
"""Bytes that have to move in a window of `body_seconds` or `unread_seconds`: less is done on purpose."""


class Phase(Enum):
    """Phases of a connection."""

    NEW = auto()
    """Nothing has come yet; browsers open connections ahead."""
    HEAD = auto()
    """A header is coming."""
    BODY = auto()
    ANSWER = auto()
    """The request is whole, the service is at work."""
    IDLE = auto()
    """Kept alive between two requests."""
    LINGER = auto()
    """Answered before the body was whole: the rest is dropped."""
    SOCKET = auto()
    """A WebSocket. It may idle for ever: pings check that its peer is there."""
    REFUSED = auto()


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
"""The label `kind` of `scas4d_connections`."""


class Handler(Protocol):
    """The protocol at work on a connection."""

    @property
    def waits_for_us(self) -> bool:
        """True if nothing can come because the service does not read now."""

    def refuse(self, refusal: Refusal) -> None:
        """Answers with the refusal, as far as it can be answered, and ends the connection."""


@dataclass(eq=False, slots=True)
class OpenConnection:
    """One open connection.

    Attributes:
        since: loop time at which the phase, or its present window, began. entered: that of the phase.
        body: bytes of body in that window; in all, and dropped those of windows before, where the body is dropped.
        moved: so much of the present body came that it is no pretence, in whatever windows.
        received: bytes since the last sweep. quiet_since: loop time of the last sweep that found any.
        served: one request was answered. write_paused: more waits to be sent than the transport likes.
    """

    handler: Handler
    transport: asyncio.Transport
    peer: Peer
    since: float
    quiet_since: float
    phase: Phase = Phase.NEW
    queue: dict[OpenConnection, None] | None = None
    counted: bool = True
    gone: bool = False
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
        """True if the body has brought next to nothing, or is dropped."""
        return self.phase is Phase.LINGER or not self.moved

    @property
    def last_bytes_at(self) -> float:
        """Loop time at which the last bytes of the body may have come."""
        return max(self.since, self.quiet_since)


@dataclass(eq=False, slots=True)
class Peer:
    """The connections of one address; those that may have to give way in queues, the oldest first."""

    address: str
    proxy: bool
    count: int = 0
    strangers: dict[OpenConnection, None] = field(default_factory=dict)
    """No header was ever completed."""
    idle: dict[OpenConnection, None] = field(default_factory=dict)
    """Between two requests."""
    bodies: dict[OpenConnection, None] = field(default_factory=dict)
