"""Middlewares of every request: the access log, the size of the body, HEAD, compression."""

from __future__ import annotations

import logging
import time

from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server import problems
from server.problems import Problem

HEAD = "scas4d.head"
"""In the scope of a HEAD that is answered as GET: a long body need not be read."""

access = logging.getLogger("scas4d.access")

LEAST_BYTES = 1000
"""Shorter answers gain nothing."""
LEVEL = 4
"""Of gzip: 9, Starlette's own, takes several times as long for a few percent."""
PACKED = (*DEFAULT_EXCLUDED_CONTENT_TYPES, "application/octet-stream", "application/vnd.numpy.npz")
"""Media types that are compressed already, or that gain little: pictures, and floats."""


class AccessLog:
    """Logs a line a request and a line a WebSocket: method, path (no query), status, seconds, bytes; no headers."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on and logs how it ended."""
        if scope["type"] not in ("http", "websocket") or not access.isEnabledFor(logging.INFO):
            await self.app(scope, receive, send)
            return
        began = time.perf_counter()
        status, taken, given = 0, 0, 0

        async def receiving() -> Message:
            nonlocal taken
            message = await receive()
            taken += len(message.get("body") or message.get("bytes") or message.get("text") or b"")
            return message

        async def sending(message: Message) -> None:
            nonlocal status, given
            if "status" in message:
                status = message["status"]
            elif message["type"] == "websocket.accept":
                status = 101
            given += len(message.get("body") or message.get("bytes") or message.get("text") or b"")
            await send(message)

        try:
            await self.app(scope, receiving, sending)
        finally:
            method = scope.get("method", "WEBSOCKET")
            # As it was sent: percent-encoded, so that no path breaks a line.
            path = scope.get("raw_path", scope["path"].encode()).decode("latin-1")
            known = {
                "method": method,
                "path": path,
                "status": status,
                "seconds": round(time.perf_counter() - began, 4),
                "bytes_in": taken,
                "bytes_out": given,
                "client": (scope.get("client") or ("",))[0],
            }
            access.info("%s %s %d", method, path, status, extra=known)


class BodyLimit:
    """Answers 413 to a body above `limit` bytes: by its announced length at once, without one while it is read."""

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self.app = app
        self.limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on with its body counted."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        announced = dict(scope["headers"]).get(b"content-length", b"0")
        if not announced.isdigit() or int(announced) > self.limit:
            await problems.answer(self._problem(announced.decode("latin-1")).document)(scope, receive, send)
            return
        read = 0

        async def counted() -> Message:
            nonlocal read
            message = await receive()
            read += len(message.get("body", b""))
            if read > self.limit:
                raise self._problem(f"more than {self.limit}")
            return message

        await self.app(scope, counted, send)

    def _problem(self, value: str) -> Problem:
        return Problem(
            413,
            f"the body is larger than {self.limit} bytes",
            field="Content-Length",
            value=value,
            remedy="send smaller or more compressed pictures, or raise SCAS4D_MAX_BODY_MB",
        )


def compressed(app: ASGIApp) -> GZipMiddleware:
    """Wraps an application: JSON and the page's files go compressed to those who accept gzip."""
    return GZipMiddleware(app, LEAST_BYTES, LEVEL, exclude_content_types=PACKED)


class HeadAsGet:
    """Answers HEAD as GET would be answered, without the body (RFC 9110, 9.3.2)."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on as GET, and drops the body of its answer."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return

        async def headers_alone(message: Message) -> None:
            if message["type"] == "http.response.body":
                if message.get("more_body"):
                    return
                message = {"type": "http.response.body", "body": b""}
            await send(message)

        await self.app({**scope, "method": "GET", HEAD: True}, receive, headers_alone)
