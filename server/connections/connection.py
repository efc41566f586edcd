"""HTTP connections of uvicorn, with limits on headers and bodies that apply before the application is called.

Without these limits, uvicorn and httptools accept headers of any length, concatenated in quadratic
time, and any number of trailers and pipelined requests. There is no time limit, and no token has
been checked yet. This module limits sizes as bytes arrive; `server.connections.guard` enforces
deadlines.
"""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar, cast

import httptools
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from server.connections import guard as guard_module
from server.connections.guard import ConnectionGuard
from server.connections.open_connection import PROGRESS_BYTES, Phase
from server.connections.refusals import Refusal, problem, response
from server.http.authentication import HEADERS

END_OF_HEAD = b"\r\n\r\n"
CHUNKED_BYTES = 64 << 10
"""Maximum number of bytes of a chunked body to parse at once; the overhead is checked after each block."""
CHUNK_OVERHEAD_BYTES = 64 << 10
"""Maximum number of bytes by which chunk headers, extensions and trailers may exceed the content."""
LARGE_READ = 16 << 10
"""Minimum size in bytes of a body piece that is passed on without a copy."""
PIPELINED = 16
"""Maximum number of pipelined requests.

If there are more, the connection is closed after this number, and the client must resend the rest. Each request takes
a few kilobytes, and a single read can contain thousands of requests.
"""
DROPPED_BYTES = 1 << 20
"""Maximum number of bytes to read and discard after a refusal, so that the peer can read the response."""


class GuardedConnection(HttpToolsProtocol):
    """HTTP connection of uvicorn with limits, and without the two copies that uvicorn makes of each body.

    A frame is about 30 MB, and copying it takes as long as reading it.

    Attributes:
        guard: the service's connection guard, set by `server.connections.config`.
    """

    guard: ClassVar[ConnectionGuard]

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._fault: Refusal | None = None
        """Fault found while parsing. It is not raised, because uvicorn would treat any exception as a bad request."""
        self._head_bytes = 0
        self._left: int | None = None
        """Bytes of the body that have not arrived yet; None if it is chunked."""
        self._delivered = 0
        self._credit = CHUNK_OVERHEAD_BYTES
        self._dropping = False
        self._dropped = 0
        self._closes = False
        """True if the connection must be closed after the current body."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Registers the connection with the guard and refuses it if a limit is reached."""
        super().connection_made(transport)
        address = self.client[0] if self.client else ""
        self._record, refusal = self.guard.admit(self, transport, self.loop, address)
        if refusal is not None:
            self.refuse(refusal)

    def connection_lost(self, exc: Exception | None) -> None:
        """Removes the connection from the guard."""
        self.guard.remove(self._record)
        super().connection_lost(exc)

    @property
    def waiting_for_service(self) -> bool:
        """Whether no bytes can arrive because the service has stopped reading or has not requested the body yet."""
        return self.flow.read_paused or (self._record.phase is Phase.BODY and self.cycle.waiting_for_100_continue)

    def data_received(self, data: bytes) -> None:
        """Parses received data in pieces, so that a header never exceeds its size limit."""
        record = self._record
        record.received += len(data)
        if self.timeout_keep_alive_task is not None:
            self._unset_keepalive_if_required()
        at = 0
        while at < len(data):
            if self._dropping:
                self._drop(len(data) - at)
                return
            if record.phase is Phase.BODY or record.phase is Phase.LINGER:
                end = at + max(1, CHUNKED_BYTES if self._left is None else self._left)
            else:
                if record.phase is not Phase.HEAD:
                    self._begin_head()
                limit = at + self.guard.limits.header_bytes - self._head_bytes
                end_of_head = data.find(END_OF_HEAD, at, limit)
                end = limit if end_of_head < 0 else end_of_head + len(END_OF_HEAD)
            whole = at == 0 and end >= len(data)
            at += self._parse(data if whole else memoryview(data)[at:end])

    def _parse(self, piece: bytes | memoryview) -> int:
        """Parses a piece and returns the number of bytes consumed."""
        record, size = self._record, len(piece)
        self._delivered, in_head = 0, record.phase is Phase.HEAD
        taken = size
        try:
            self.parser.feed_data(piece)
        except httptools.HttpParserUpgrade as upgrade:
            taken = max(1, int(upgrade.args[0]))
            if self._fault is None:
                self._upgrade()
        except httptools.HttpParserError:
            self._fault = self._fault or Refusal.MALFORMED
        if self._fault is None and record.phase is Phase.HEAD:
            self._head_bytes += size if in_head else size - self._delivered
            if self._head_bytes >= self.guard.limits.header_bytes:
                self._fault = self._too_large()
        elif self._fault is None and not in_head and self._left is None:
            # Content offsets overhead up to a cap. Without the cap, a large body would permit an endless trailer, which
            # is concatenated in quadratic time like headers.
            self._credit = min(CHUNK_OVERHEAD_BYTES, self._credit + self._delivered) - (size - self._delivered)
            if self._credit < 0:
                self._fault = Refusal.BODY_OVERHEAD
        if self._fault is not None:
            self.refuse(self._fault)
            return size
        return taken

    def _begin_head(self) -> None:
        self._head_bytes = 0
        self.guard.set_phase(self._record, Phase.HEAD, self.loop.time())

    def _too_large(self) -> Refusal:
        return Refusal.URL_SIZE if 2 * len(self.url or b"") > self.guard.limits.header_bytes else Refusal.HEAD_SIZE

    def on_message_begin(self) -> None:
        """Starts a request, which may begin in the same piece of data in which the previous request ended."""
        super().on_message_begin()
        if self._record.phase is not Phase.HEAD:
            self._begin_head()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Stores a header line.

        Trailers are discarded, because they are unused and must not be mistaken for headers.
        """
        if self._record.phase is not Phase.HEAD:
            return
        if len(self.headers) >= guard_module.HEADER_LINES:
            self._fault = self._fault or Refusal.HEAD_LINES
            return
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Passes the request to the application, unless it is refused."""
        if self._fault is None and len(self.pipeline) >= PIPELINED:
            self._fault = Refusal.PIPELINED
        if self._fault is None and self._add_content_length() > self.guard.limits.header_bytes:
            self._fault = self._too_large()
        if self._fault is not None:
            return
        before = self.cycle
        super().on_headers_complete()
        if self.cycle is before:  # the request is the handshake of a WebSocket
            return
        self._left, chunked = 0, False
        for name, value in self.headers:
            if name == b"content-length":
                self._left = int(value)  # httptools rejects invalid and repeated values
            elif name == b"transfer-encoding":
                chunked = True
        phase = Phase.ANSWER
        if chunked or self._left:
            phase = Phase.BODY
            self._credit = CHUNK_OVERHEAD_BYTES
            if chunked:
                self._left = None
            # The task that runs the application starts after this call and therefore uses this transport.
            self.cycle.transport = _DelayedClose(self)
        self.guard.set_phase(self._record, phase, self.loop.time())

    def _add_content_length(self) -> int:
        return len(self.url) + sum(len(name) + len(value) for name, value in self.headers)

    def on_body(self, body: bytes) -> None:
        """Appends a piece of the body."""
        if self._fault is not None:
            return
        self._delivered += len(body)
        record = self._record
        record.body += len(body)
        if record.body >= PROGRESS_BYTES:
            record.moved = True
        if self._left is not None:
            self._left -= len(body)
        cycle = self.cycle
        if not cycle.body:
            # The buffer is empty. Adding a piece to empty bytes returns the piece itself without a copy, and so does
            # calling `bytes` on it. Small pieces are collected in a bytearray, which is not copied at each addition.
            cycle.body = b"" if len(body) >= LARGE_READ else bytearray()  # type: ignore[assignment]
        elif isinstance(cast("bytes | bytearray", cycle.body), bytes):
            cycle.body = bytearray(cycle.body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Ends a request; its response may still be in progress or already sent."""
        if self._fault is not None:
            return
        super().on_message_complete()
        if self._record.phase is Phase.BODY:
            self.guard.set_phase(self._record, Phase.ANSWER, self.loop.time())
        elif self._record.phase is Phase.LINGER:
            self.guard.set_phase(self._record, Phase.IDLE, self.loop.time())
            if self._closes:
                self.transport.close()

    def on_response_complete(self) -> None:
        """Waits for the next request, or for the end of a body that is no longer needed."""
        super().on_response_complete()
        record = self._record
        record.served = True
        if not self.cycle.response_complete or self._dropping:
            return
        if record.phase is Phase.BODY:
            self._unset_keepalive_if_required()
            self.guard.set_phase(record, Phase.LINGER, self.loop.time())
        elif record.phase is Phase.ANSWER:
            self.guard.set_phase(record, Phase.IDLE, self.loop.time())

    def close_after_body(self) -> None:
        """Closes the connection after the current body has ended or taken too long.

        Closing it while bytes are unread would reset the connection, and the response would be lost.
        """
        if self._record.phase in (Phase.BODY, Phase.LINGER) and not self._dropping:
            self._closes = True
            self.guard.set_phase(self._record, Phase.LINGER, self.loop.time())
            self.flow.resume_reading()
        else:
            self.transport.close()

    def refuse(self, refusal: Refusal) -> None:
        """Counts the refusal, sends it unless another response is in progress, and closes the connection."""
        if self._dropping or self.transport.is_closing():
            return
        self.guard.count_refusal(refusal)
        self._dropping = True
        record, cycle, now = self._record, self.cycle, self.loop.time()
        answering = cycle is not None and not cycle.response_complete
        if record.phase in (Phase.BODY, Phase.LINGER):
            if answering and (cycle.response_started or self.pipeline):
                self.transport.abort()
                return
            answered = cycle.response_complete
            cycle.disconnected = True
            cycle.waiting_for_100_continue = False
            cycle.message_event.set()
        elif answering:  # earlier requests are answered first, and the last of them closes the connection
            cycle.keep_alive = False
            self.guard.set_phase(record, Phase.ANSWER, now)
            return
        else:
            answered = False
        self.guard.set_phase(record, Phase.REFUSED, now)
        self._unset_keepalive_if_required()
        if not answered:
            self.transport.write(response(problem(refusal, self.guard.limits.of_refusal(refusal)), HEADERS))
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self.flow.resume_reading()

    def _drop(self, size: int) -> None:
        self._dropped += size
        if self._dropped <= DROPPED_BYTES:
            return
        if self._record.phase is Phase.REFUSED:
            self.transport.abort()
        else:
            self.flow.pause_reading()

    def _upgrade(self) -> None:
        """Switches the connection to a WebSocket.

        A request for any other protocol is answered without an upgrade. The data after it belongs to that protocol and
        is discarded, so that it is not mistaken for further requests.
        """
        if not self._should_upgrade():
            self.cycle.keep_alive = False
            self._dropping = True
        elif self.cycle is not None and not self.cycle.response_complete:
            self._fault = Refusal.MALFORMED  # the pending response would be written into the WebSocket
        else:
            self._dropping = True  # discards data received with the handshake; the WebSocket reads later data
            self.handle_websocket_upgrade()

    def pause_writing(self) -> None:
        """Records that the peer reads more slowly than the service writes."""
        super().pause_writing()
        self._record.write_paused = True

    def resume_writing(self) -> None:
        """Records that the peer has read most of the unsent data."""
        super().resume_writing()
        self._record.write_paused = False


class _DelayedClose(asyncio.Transport):
    """Transport of a response whose request body is still arriving; closing is delayed until the end of the body."""

    def __init__(self, connection: GuardedConnection) -> None:
        super().__init__()
        self._connection = connection
        self.write = connection.transport.write  # type: ignore[method-assign]
        self.is_closing = connection.transport.is_closing  # type: ignore[method-assign]

    def close(self) -> None:
        """Closes the connection after the body."""
        self._connection.close_after_body()
