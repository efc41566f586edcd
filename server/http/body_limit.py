"""The body limit: no request may fill the memory or the disk."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server import problems


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

    def _problem(self, value: str) -> problems.Problem:
        return problems.Problem(
            413,
            f"the body is larger than {self.limit} bytes",
            field="Content-Length",
            value=value,
            remedy="send smaller or more compressed pictures, or raise SCAS4D_MAX_BODY_MB",
        )
