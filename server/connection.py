"""Connections of uvicorn: bodies handed on as they come, WebSocket messages bounded one by one, memory kept between."""

from __future__ import annotations

import contextlib
import ctypes

from starlette.types import Scope
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.http11 import Request

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
KEPT_BYTES = 32 << 20
EARLY_BYTES = 1 << 16
"""Largest message of a WebSocket before its handshake is answered: nobody has to send one then."""
LIMIT = "scas4d.message_limit"


class Connection(HttpToolsProtocol):
    """uvicorn's own, without its two copies of a body: a frame is some 30 MB, and each costs what reading it does."""

    def on_body(self, body: bytes) -> None:
        """Takes a piece of a body."""
        if not self.cycle.body:
            # Nothing waits: `+=` to bytes that are empty is the piece itself, and so is `bytes` of it.
            self.cycle.body = b""  # type: ignore[assignment]
        super().on_body(body)


class Socket(WebSocketsSansIOProtocol):
    """uvicorn's own, whose largest message is the application's to say: it is refused (1009) before it is in memory."""

    def handle_connect(self, event: Request) -> None:
        """Begins with the handshake."""
        self.conn.max_message_size = EARLY_BYTES
        super().handle_connect(event)
        if hasattr(self, "scope"):
            self.scope["extensions"][LIMIT] = {"set": self._limit}

    def _limit(self, size: int) -> None:
        self.conn.max_message_size = size


def limit_messages(scope: Scope, size: int) -> None:
    """Lets a WebSocket have messages of so many bytes, none larger; to be called before it is accepted."""
    extension = scope.get("extensions", {}).get(LIMIT)
    if extension is not None:  # another server has a limit of its own
        extension["set"](size)


def keep_freed_memory() -> None:
    """Tells glibc to keep what is freed, up to `KEPT_BYTES`.

    A socket is read in pieces of 256 kB, for which it would otherwise ask the kernel for fresh memory each time: that
    takes longer than to fill it. Elsewhere nothing happens.
    """
    with contextlib.suppress(AttributeError, OSError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_MMAP_THRESHOLD, KEPT_BYTES)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
