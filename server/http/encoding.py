"""Middlewares of answers: HEAD is GET without the body, and text is compressed for those who accept it."""

from __future__ import annotations

from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LEAST_BYTES = 1000
"""Shorter answers gain nothing."""
LEVEL = 4
"""Of gzip: 9, Starlette's own, takes several times as long for a few percent."""
PACKED = (*DEFAULT_EXCLUDED_CONTENT_TYPES, "application/octet-stream", "application/vnd.numpy.npz")
"""Media types that are compressed already, or that gain little: pictures, and floats."""


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

        await self.app({**scope, "method": "GET"}, receive, headers_alone)
