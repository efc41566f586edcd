"""WebSockets of uvicorn with limits: size of messages, malformed handshakes, peers that do not read."""

from __future__ import annotations

import asyncio
from typing import ClassVar

from starlette.types import Scope
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame
from websockets.http11 import Request

from server.connections.guard import LINGER_LONGEST_S, ConnectionGuard
from server.connections.record import Phase
from server.connections.refusals import Refusal, problem, response
from server.http.authentication import HEADERS

EARLY_BYTES = 1 << 16
"""Largest message of a WebSocket before its handshake is answered: no client has to send one then."""
SMALL_FRAGMENT = 4096
PONG = b"\x8a"
"""First byte of such a frame."""
LIMIT = "scas4d.message_limit"


class Socket(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket; the application sets its largest message, and a larger one is refused (1009) unread.

    `guard` is that of the service, set by `server.connections.config`.
    """

    guard: ClassVar[ConnectionGuard]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Takes the connection over from the HTTP request that asked for the upgrade."""
        super().connection_made(transport)
        self._pong = b""
        """The answer to the newest ping, while the peer does not read."""
        self._fell_behind = False
        """True if more waited than the transport likes, at some time since the last ping was sent."""
        self._record = self.guard.hand_over(transport, self, self.loop.time())

    def connection_lost(self, exc: Exception | None) -> None:
        """Gives the place among the open connections back."""
        self.guard.leave(self._record)
        super().connection_lost(exc)

    @property
    def waits_for_us(self) -> bool:
        """A WebSocket has no deadline but while it is being closed, and then it reads."""
        return False

    def refuse(self, refusal: Refusal) -> None:
        """Answers a handshake that cannot be read, and ends the connection."""
        self.guard.refused(refusal)
        self.transport.write(response(problem(refusal), HEADERS))
        self.transport.close()

    def data_received(self, data: bytes) -> None:
        """Takes what comes; a handshake that cannot be read is refused, where uvicorn would wait for ever."""
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
        """Begins with the handshake."""
        self.conn.max_message_size = EARLY_BYTES
        super().handle_connect(event)
        if hasattr(self, "scope"):
            self.scope["extensions"][LIMIT] = {"set": self._limit}

    def _limit(self, size: int) -> None:
        self.conn.max_message_size = size

    def handle_cont(self, event: Frame) -> None:
        """Takes a fragment of a message. Small ones are joined: an object each would take forty times their bytes."""
        if event.fin or len(event.data) > SMALL_FRAGMENT:
            super().handle_cont(event)
            return
        frames: list[bytes | bytearray] = self.frames  # type: ignore[assignment]
        if len(frames) > 1 and isinstance(frames[-1], bytearray):
            frames[-1] += event.data
        else:
            frames.append(bytearray(event.data))

    def handle_parser_exception(self) -> None:
        """Ends a connection that breaks the protocol, or whose message is too large (1009).

        What it goes on sending is read and dropped for a while: uvicorn closes at once, which resets the connection,
        and the peer loses the reason.
        """
        sent = self.conn.close_sent
        if sent is None:  # the handshake is not answered yet
            self.transport.abort()
            return
        self.queue.put_nowait({"type": "websocket.disconnect", "code": sent.code, "reason": sent.reason})
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.guard.enter(self._record, Phase.LINGER, self.loop.time())
        # The application ends now; while there is such a timer, uvicorn does not close behind it. The
        # guard does, sooner.
        self.close_timer = self.loop.call_later(LINGER_LONGEST_S, self.transport.close)
        if self.transport.can_write_eof():
            self.transport.write_eof()
        if self.read_paused:
            self.read_paused = False
            self.transport.resume_reading()

    def handle_ping(self) -> None:
        """Answers a ping; while the peer does not read, only the newest is remembered, as RFC 6455 (5.5.3) allows: each
        would add an answer to what waits. What the peer sends is read all the same: its pongs show that it is there.
        """
        if not self._record.write_paused:
            super().handle_ping()
            return
        for frame in self.conn.data_to_send():
            if frame[:1] == PONG:
                self._pong = frame
            else:  # the answer to a close that came behind the pings; nothing may follow it
                self._pong = b""
                self.transport.write(frame)

    def pause_writing(self) -> None:
        """Notes that the peer does not read as fast as it is written."""
        super().pause_writing()
        self._record.write_paused = self._fell_behind = True

    def resume_writing(self) -> None:
        """Notes that the peer has read, and answers its newest ping."""
        super().resume_writing()
        self._record.write_paused = False
        pong, self._pong = self._pong, b""
        if pong and self.conn.close_sent is None and not self.transport.is_closing():
            self.transport.write(pong)

    def send_keepalive_ping(self) -> None:
        """Sends a ping to a peer that is silent."""
        self._fell_behind = self._record.write_paused
        super().send_keepalive_ping()

    def keepalive_timeout(self) -> None:
        """Ends a connection that has not answered a ping, unless the ping may not have been read yet.

        Megabytes may wait before it, in the kernel too. Where the peer does not read them, the guard ends it.
        """
        if self._fell_behind and self.ping_timeout is not None:
            self._fell_behind = self._record.write_paused
            self.pong_timer = self.loop.call_later(self.ping_timeout, self.keepalive_timeout)
            return
        super().keepalive_timeout()


def limit_messages(scope: Scope, size: int) -> None:
    """Lets a WebSocket have messages of so many bytes, none larger; to be called before it is accepted."""
    extension = scope.get("extensions", {}).get(LIMIT)
    if extension is not None:  # another server has a limit of its own
        extension["set"](size)
