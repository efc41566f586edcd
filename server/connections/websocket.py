"""WebSockets of uvicorn, protected against large messages, malformed handshakes and peers that do not read."""

from __future__ import annotations

import asyncio
from typing import ClassVar

from starlette.types import Scope
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame
from websockets.http11 import Request

from server.connections.guard import LINGER_LONGEST_S, ConnectionGuard
from server.connections.open_connection import Phase
from server.connections.refusals import Refusal, problem, response
from server.http.authentication import HEADERS

EARLY_BYTES = 1 << 16
"""Maximum message size in bytes before the handshake is answered; clients need not send messages that early."""
SMALL_FRAGMENT = 4096
"""Maximum size in bytes of a fragment to join with the previous one."""
PONG = b"\x8a"
"""First byte of a pong frame."""
LIMIT = "scas4d.message_limit"
"""Key of the scope extension that the application uses to set the maximum message size."""


class GuardedWebSocket(WebSocketsSansIOProtocol):
    """WebSocket of uvicorn with a maximum message size that the application sets.

    A larger message is rejected with close code 1009 without being read.

    Attributes:
        guard: the service's connection guard, set by `server.connections.config`.
    """

    guard: ClassVar[ConnectionGuard]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Takes over the connection of the HTTP request that requested the upgrade."""
        super().connection_made(transport)
        self._pong = b""
        """Pong for the newest ping, held back while the peer is not reading."""
        self._fell_behind = False
        """True if writing was paused at any time since the last ping was sent."""
        self._record = self.guard.upgrade(transport, self, self.loop.time())

    def connection_lost(self, exc: Exception | None) -> None:
        """Removes the connection from the guard."""
        self.guard.remove(self._record)
        super().connection_lost(exc)

    @property
    def waiting_for_service(self) -> bool:
        """Always False: a WebSocket has a deadline only while it is closing, and the service reads during that time."""
        return False

    def refuse(self, refusal: Refusal) -> None:
        """Responds to an invalid handshake and closes the connection."""
        self.guard.count_refusal(refusal)
        self.transport.write(response(problem(refusal), HEADERS))
        self.transport.close()

    def data_received(self, data: bytes) -> None:
        """Handles received data and refuses an invalid handshake, which would make uvicorn wait forever."""
        self._record.received += len(data)
        if self._record.phase is Phase.LINGER:
            self._record.body += len(data)
            return
        if self.transport.is_closing():
            return
        super().data_received(data)
        if not self.handshake_initiated and self.conn.handshake_exc is not None:
            self.refuse(Refusal.MALFORMED)

    def handle_connect(self, event: Request) -> None:
        """Handles the handshake."""
        self.conn.max_message_size = EARLY_BYTES
        super().handle_connect(event)
        if hasattr(self, "scope"):
            self.scope["extensions"][LIMIT] = {"set": self._limit}

    def _limit(self, size: int) -> None:
        self.conn.max_message_size = size

    def handle_cont(self, event: Frame) -> None:
        """Appends a fragment of a message.

        Small fragments are joined, because a separate object for each would take up to forty times its size.
        """
        if event.fin or len(event.data) > SMALL_FRAGMENT:
            super().handle_cont(event)
            return
        frames: list[bytes | bytearray] = self.frames  # type: ignore[assignment]
        if len(frames) > 1 and isinstance(frames[-1], bytearray):
            frames[-1] += event.data
        else:
            frames.append(bytearray(event.data))

    def handle_parser_exception(self) -> None:
        """Closes a connection after a protocol violation or an oversized message (1009).

        Data that the peer continues to send is read and discarded for a while. uvicorn would close the connection
        immediately, which would reset it, so that the peer would not receive the reason.
        """
        sent = self.conn.close_sent
        if sent is None:  # the handshake is not answered yet
            self.transport.abort()
            return
        self.queue.put_nowait({"type": "websocket.disconnect", "code": sent.code, "reason": sent.reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.guard.set_phase(self._record, Phase.LINGER, self.loop.time())
        # The application returns now. While this timer exists, uvicorn leaves the connection open
        # after that. The guard closes the connection before the timer expires.
        self.close_timer = self.loop.call_later(LINGER_LONGEST_S, self.transport.close)
        if self.transport.can_write_eof():
            self.transport.write_eof()
        if self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()

    def handle_ping(self) -> None:
        """Responds to a ping.

        While the peer is not reading, only the response to the newest ping is kept, as RFC 6455 (5.5.3) permits.
        Otherwise, each ping would add a response to the write buffer. Data from the peer is still read, since its pongs
        show that it is alive.
        """
        if not self._record.write_paused:
            super().handle_ping()
            return
        for frame in self.conn.data_to_send():
            if frame[:1] == PONG:
                self._pong = frame
            else:  # the response to a close frame, after which nothing may be sent
                self._pong = b""
                self.transport.write(frame)

    def pause_writing(self) -> None:
        """Records that the peer reads more slowly than the service writes."""
        super().pause_writing()
        self._record.write_paused = self._fell_behind = True

    def resume_writing(self) -> None:
        """Records that the peer has read most of the unsent data, and answers its newest ping."""
        super().resume_writing()
        self._record.write_paused = False
        pong, self._pong = self._pong, b""
        if pong and self.conn.close_sent is None and not self.transport.is_closing():
            self.transport.write(pong)

    def send_keepalive_ping(self) -> None:
        """Sends a keepalive ping to the peer."""
        self._fell_behind = self._record.write_paused
        super().send_keepalive_ping()

    def keepalive_timeout(self) -> None:
        """Closes a connection that has not answered a ping, unless the peer may not have read the ping yet.

        Megabytes of data may be queued ahead of the ping, including in the kernel. If the peer does not read them, the
        guard closes the connection.
        """
        if self._fell_behind and self.ping_timeout is not None:
            self._fell_behind = self._record.write_paused
            self.pong_timer = self.loop.call_later(self.ping_timeout, self.keepalive_timeout)
            return
        super().keepalive_timeout()


def limit_messages(scope: Scope, size: int) -> None:
    """Sets the maximum message size of a WebSocket to `size` bytes; call this before accepting the WebSocket."""
    extension = scope.get("extensions", {}).get(LIMIT)
    if extension is not None:  # other servers have their own limit
        extension["set"](size)
