"""Middleware for every request: access log, body size limit, HEAD requests and compression."""

from __future__ import annotations

import logging
import time

from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server import problems
from server.problems import Problem

HEAD = "scas4d.head"
"""Key in the scope of a HEAD request that is handled as GET, so that routes need not read a long body."""

access = logging.getLogger("scas4d.access")

MIN_BYTES = 1000
"""Minimum size in bytes of a response to compress; shorter responses do not benefit."""
LEVEL = 4
"""Gzip compression level; Starlette's default of 9 takes several times as long and saves only a few percent."""
COMPRESSED_TYPES = (*DEFAULT_EXCLUDED_CONTENT_TYPES, "application/octet-stream", "application/vnd.numpy.npz")
"""Media types that are not compressed, because they are already compressed (images) or gain little (floats)."""


class AccessLog:
    """Middleware that logs one line per request and per WebSocket.

    Each line contains the method, path, status, duration, sizes and client address, but no query or headers.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handles the request and logs its outcome."""
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
            # The path is logged percent-encoded, as sent, so that it cannot contain a line break.
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
    """Middleware that responds with 413 to bodies of more than `limit` bytes, and with 415 to compressed bodies.

    A body with a Content-Length is rejected immediately; any other body is rejected while it is being read.
    """

    def __init__(self, app: ASGIApp, limit: int) -> None:
        self.app = app
        self.limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on while counting the bytes of its body."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = dict(scope["headers"])
        coding = headers.get(b"content-encoding", b"identity").decode("latin-1").strip()
        if coding.lower() not in ("", "identity"):
            await problems.refuse(_coding_problem(coding), scope, receive, send)
            return
        announced = headers.get(b"content-length", b"0")
        if not announced.isdigit() or int(announced) > self.limit:
            await problems.problem_response(self._problem(announced.decode("latin-1")).document)(scope, receive, send)
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
            f"the body exceeds the limit of {self.limit} bytes",
            field="Content-Length",
            value=value,
            remedy="send smaller or more strongly compressed images, or raise SCAS4D_MAX_BODY_MB",
        )


def _coding_problem(coding: str) -> Problem:
    return Problem(
        415,
        f"the body has the content coding {coding!r}, but only bodies without one are read",
        field="Content-Encoding",
        value=coding,
        remedy="send the body uncompressed, without Content-Encoding; images are compressed already",
        headers={"Accept-Encoding": "identity"},
    )


def compress_responses(app: ASGIApp) -> GZipMiddleware:
    """Wraps an application so that JSON and page files are compressed with gzip for clients that accept it."""
    return GZipMiddleware(app, MIN_BYTES, LEVEL, exclude_content_types=COMPRESSED_TYPES)


class HeadAsGet:
    """Middleware that responds to HEAD like GET, but without the body (RFC 9110, 9.3.2)."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a HEAD request on as GET and drops the body of the response."""
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
