"""HTTP connections of uvicorn: headers and bodies bounded in size and time before the application is asked.

uvicorn and httptools take whatever comes: a header of any length (joined anew with each piece, in quadratic time), as
many trailers and pipelined requests as fit through the wire, for as long as the peer likes. All of that happens before
a token is looked at. `server.connections.guard` watches the time; the sizes are watched here, where the bytes come in.
"""

from __future__ import annotations

import asyncio
from typing import Any, ClassVar, cast

import httptools
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from server.connections import guard as guard_module
from server.connections.guard import ConnectionGuard
from server.connections.record import PROGRESS_BYTES, Phase
from server.connections.refusals import Refusal, problem, response
from server.http.authentication import HEADERS

END_OF_HEAD = b"\r\n\r\n"
CHUNKED_BYTES = 64 << 10
"""A chunked body is parsed in pieces of at most so many bytes: its overhead is looked at after each."""
OVERHEAD_BYTES = 64 << 10
"""Chunk headers, extensions and trailers that may come without as much content."""
LARGE_PIECE = 16 << 10
PIPELINED = 16
"""Requests that wait for the answer before theirs; the connection ends behind them, and the client sends the rest
again. Each costs some kilobytes, and thousands fit into what is read at once."""
DROPPED_BYTES = 1 << 20
"""Read and dropped from a connection that was refused, so that its peer gets to read the answer."""


class Connection(HttpToolsProtocol):
    """uvicorn's HTTP connection, guarded, and without its two copies of a body: a frame is some 30 MB, and each copy
    costs as much as reading it.

    `guard` is that of the service, set by `server.connections.config`.
    """

    guard: ClassVar[ConnectionGuard]

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._fault: Refusal | None = None
        """Found while parsing: an exception there would be answered as any other bad request."""
        self._head_bytes = 0
        self._left: int | None = None
        """Bytes of the body that are missing; None where it is chunked."""
        self._delivered = 0
        self._credit = OVERHEAD_BYTES
        self._dropping = False
        self._dropped = 0
        self._closes = False
        """The connection ends with the body that is coming."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Takes a place among the open connections, or is refused."""
        super().connection_made(transport)
        address = self.client[0] if self.client else ""
        self._record, refusal = self.guard.admit(self, transport, self.loop, address)
        if refusal is not None:
            self.refuse(refusal)

    def connection_lost(self, exc: Exception | None) -> None:
        """Gives the place back."""
        self.guard.leave(self._record)
        super().connection_lost(exc)

    @property
    def waits_for_us(self) -> bool:
        """True if nothing can come because the service does not read now, or has yet to ask for the body."""
        return self.flow.read_paused or (self._record.phase is Phase.BODY and self.cycle.waiting_for_100_continue)

    def data_received(self, data: bytes) -> None:
        """Parses what comes, piece by piece: never more of a header than it may still have."""
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
        """Parses a piece; returns the bytes of it that were taken."""
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
            # Delivered bytes pay for overhead, but do not add up: a large body must not buy an endless trailer,
            # which is joined in quadratic time as a header is.
            self._credit = min(OVERHEAD_BYTES, self._credit + self._delivered) - (size - self._delivered)
            if self._credit < 0:
                self._fault = Refusal.BODY_OVERHEAD
        if self._fault is not None:
            self.refuse(self._fault)
            return size
        return taken

    def _begin_head(self) -> None:
        self._head_bytes = 0
        self.guard.enter(self._record, Phase.HEAD, self.loop.time())

    def _too_large(self) -> Refusal:
        return Refusal.URL_SIZE if 2 * len(self.url or b"") > self.guard.limits.header_bytes else Refusal.HEAD_SIZE

    def on_message_begin(self) -> None:
        """Begins with a request, maybe in the piece in which the one before ended."""
        super().on_message_begin()
        if self._record.phase is not Phase.HEAD:
            self._begin_head()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Takes a line of the header. Trailers are dropped: they are not used, and must not pass for headers."""
        if self._record.phase is not Phase.HEAD:
            return
        if len(self.headers) >= guard_module.HEADER_LINES:
            self._fault = self._fault or Refusal.HEAD_LINES
            return
        super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Hands the request on, unless it is refused."""
        if self._fault is None and len(self.pipeline) >= PIPELINED:
            self._fault = Refusal.PIPELINED
        if self._fault is None and self._summed() > self.guard.limits.header_bytes:
            self._fault = self._too_large()
        if self._fault is not None:
            return
        before = self.cycle
        super().on_headers_complete()
        if self.cycle is before:  # the handshake of a WebSocket
            return
        self._left, chunked = 0, False
        for name, value in self.headers:
            if name == b"content-length":
                self._left = int(value)  # httptools refuses what is no number, and a second one
            elif name == b"transfer-encoding":
                chunked = True
        phase = Phase.ANSWER
        if chunked or self._left:
            phase = Phase.BODY
            self._credit = OVERHEAD_BYTES
            if chunked:
                self._left = None
            # The task that answers begins after this call.
            self.cycle.transport = _Lingering(self)
        self.guard.enter(self._record, phase, self.loop.time())

    def _summed(self) -> int:
        return len(self.url) + sum(len(name) + len(value) for name, value in self.headers)

    def on_body(self, body: bytes) -> None:
        """Takes a piece of a body."""
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
            # Nothing waits: `+=` to bytes that are empty is the piece itself, and so is `bytes` of it. Small pieces
            # are joined: they go into a bytearray, which grows without being copied each time.
            cycle.body = b"" if len(body) >= LARGE_PIECE else bytearray()  # type: ignore[assignment]
        elif isinstance(cast("bytes | bytearray", cycle.body), bytes):
            cycle.body = bytearray(cycle.body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Ends a request; its answer may be under way, or out."""
        if self._fault is not None:
            return
        super().on_message_complete()
        if self._record.phase is Phase.BODY:
            self.guard.enter(self._record, Phase.ANSWER, self.loop.time())
        elif self._record.phase is Phase.LINGER:
            self.guard.enter(self._record, Phase.IDLE, self.loop.time())
            if self._closes:
                self.transport.close()

    def on_response_complete(self) -> None:
        """Waits for the next request, or for the end of a body that is not needed any more."""
        super().on_response_complete()
        record = self._record
        record.served = True
        if not self.cycle.response_complete or self._dropping:
            return
        if record.phase is Phase.BODY:
            self._unset_keepalive_if_required()
            self.guard.enter(record, Phase.LINGER, self.loop.time())
        elif record.phase is Phase.ANSWER:
            self.guard.enter(record, Phase.IDLE, self.loop.time())

    def close_behind_body(self) -> None:
        """Closes the connection once the body that is coming has ended, or has gone on for too long: closed before,
        with bytes unread, it would be reset and the answer lost.
        """
        if self._record.phase in (Phase.BODY, Phase.LINGER) and not self._dropping:
            self._closes = True
            self.guard.enter(self._record, Phase.LINGER, self.loop.time())
            self.flow.resume_reading()
        else:
            self.transport.close()

    def refuse(self, refusal: Refusal) -> None:
        """Counts the refusal, answers with it where nothing else is being answered, and ends the connection."""
        if self._dropping or self.transport.is_closing():
            return
        self.guard.refused(refusal)
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
        elif answering:  # requests before it are answered, and the last of them ends the connection
            cycle.keep_alive = False
            self.guard.enter(record, Phase.ANSWER, now)
            return
        else:
            answered = False
        self.guard.enter(record, Phase.REFUSED, now)
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
        """Goes on as a WebSocket. Another protocol is not spoken here: the request is answered as it is, and whatever
        follows belongs to that protocol and must not be taken for requests.
        """
        if not self._should_upgrade():
            self.cycle.keep_alive = False
            self._dropping = True
        elif self.cycle is not None and not self.cycle.response_complete:
            self._fault = Refusal.MALFORMED  # the answer before would be written into the WebSocket
        else:
            self._dropping = True  # what came with the handshake; the WebSocket reads what comes after it
            self.handle_websocket_upgrade()

    def pause_writing(self) -> None:
        """Notes that the peer does not read as fast as it is written."""
        super().pause_writing()
        self._record.write_paused = True

    def resume_writing(self) -> None:
        """Notes that the peer has read."""
        super().resume_writing()
        self._record.write_paused = False


class _Lingering(asyncio.Transport):
    """The transport of a response whose request is still coming: closing it waits for the end of the body."""

    def __init__(self, connection: Connection) -> None:
        super().__init__()
        self._connection = connection
        self.write = connection.transport.write  # type: ignore[method-assign]
        self.is_closing = connection.transport.is_closing  # type: ignore[method-assign]

    def close(self) -> None:
        """Closes the connection behind the body."""
        self._connection.close_behind_body()
