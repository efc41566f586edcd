"""The door: a pure ASGI middleware in front of every HTTP request and every WebSocket.

In this order: the address that was connected to (nothing beyond the loopback without a token), Host and Origin
(`server.http.origin`), tokens in URLs (refused: they end up in logs), the bearer token or, for WebSockets, a ticket.
"""

from __future__ import annotations

import hashlib
import hmac
from urllib.parse import parse_qsl

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server import problems
from server.http import origin
from server.http.tickets import SUBPROTOCOL, Tickets
from server.problems import Problem
from server.settings import ServerSettings, is_loopback

OPEN = frozenset(
    {"/", "/viewer", "/favicon.ico", "/health/live", "/docs", "/docs/oauth2-redirect", "/redoc", "/openapi.json"}
)
"""What bears no data and can be read without a token: the page that asks for one, and the description of the API."""
OPEN_FOLDERS = ("/viewer/",)
"""Files of the viewer's page."""
IN_URL = frozenset({"token", "access_token", "api_key", "ticket", "authorization"})

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Of every answer: nothing of the service is shown inside another site, nor guessed to be another kind of file."""


class Door:
    """Refuses with a problem document; a WebSocket's handshake too."""

    def __init__(self, app: ASGIApp, settings: ServerSettings, tickets: Tickets) -> None:
        self.app = app
        self.hosts = settings.allowed_hosts
        self.origins = settings.allowed_origins
        self.tickets = tickets
        secret = settings.secret
        self._token = None if secret is None else _hashed(secret)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on, or answers it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        sending = _with_headers(send) if scope["type"] == "http" else _answering(scope, receive, send)
        try:
            self._reached(scope)
            origin.check(scope, self.hosts, self.origins)
            self._no_token_in_url(scope)
            if scope["type"] == "websocket":
                sending = self._ticket(scope, sending)
            elif not self._is_open(scope):
                self._bearer(scope)
        except Problem as problem:
            await problems.refuse(problem, scope, receive, sending)
            return
        await self.app(scope, receive, sending)

    def _reached(self, scope: Scope) -> None:
        """However the service was started: without a token, only this machine may reach it, nor may others through a
        trusted proxy on this machine.
        """
        ends = [scope[end][0] for end in ("server", "client") if scope.get(end)]
        if self._token is None and not all(map(is_loopback, ends)):
            raise Problem(
                403,
                "the service can be reached from other machines and has no token",
                field="SCAS4D_TOKEN",
                remedy="set a token and start it anew, or listen at 127.0.0.1",
            )

    def _no_token_in_url(self, scope: Scope) -> None:
        query = scope.get("query_string", b"").decode("latin-1")
        for name, _ in parse_qsl(query, keep_blank_values=True):
            if name.lower() in IN_URL:
                raise Problem(
                    400,
                    "a secret in an address ends up in logs and histories",
                    field=name,
                    remedy="send the token as `Authorization: Bearer`, a ticket as WebSocket subprotocol; if this "
                    "was the real one, replace it",
                )

    def _is_open(self, scope: Scope) -> bool:
        path = scope["path"]
        # CORS asks with OPTIONS, without the token, what it may send; Origin was checked above.
        return path in OPEN or path.startswith(OPEN_FOLDERS) or (scope["method"] == "OPTIONS" and bool(self.origins))

    def _bearer(self, scope: Scope) -> None:
        if self._token is None:
            return
        given = Headers(scope=scope).getlist("authorization")
        scheme, _, token = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        right = hmac.compare_digest(_hashed(token.strip()), self._token)  # hashed first: the length tells nothing
        if scheme.lower() != "bearer" or not right:
            raise Problem(
                401,
                "the token is not the service's" if given else "the service asks for a token",
                field="Authorization",
                remedy="send `Authorization: Bearer` and the token that the service was started with",
                headers={"WWW-Authenticate": 'Bearer realm="scas4d"' + (', error="invalid_token"' if given else "")},
            )

    def _ticket(self, scope: Scope, send: Send) -> Send:
        """Takes the ticket out of what is offered; the sender that answers with it where nothing else is accepted."""
        offered = scope.get("subprotocols", [])
        shown = [name for name in offered if name.startswith(SUBPROTOCOL)]
        scope["subprotocols"] = [name for name in offered if name not in shown]
        scope["headers"] = [(name, value) for name, value in scope["headers"] if name != b"sec-websocket-protocol"]
        if scope["subprotocols"]:
            scope["headers"].append((b"sec-websocket-protocol", ", ".join(scope["subprotocols"]).encode("latin-1")))
        if self._token is not None:
            if len(shown) == 1:
                if not self.tickets.redeem(shown[0].removeprefix(SUBPROTOCOL)):
                    raise Problem(
                        401,
                        "the ticket is used, too old, or none",
                        field="Sec-WebSocket-Protocol",
                        remedy="fetch another with POST /v1/tickets and use it at once",
                        headers={"WWW-Authenticate": 'Bearer realm="scas4d"'},
                    )
            else:
                self._bearer(scope)
        if not shown:
            return send

        async def echoing(message: Message) -> None:
            # A browser gives up a WebSocket that accepts none of the subprotocols it offered.
            if message["type"] == "websocket.accept" and not message.get("subprotocol"):
                message = {**message, "subprotocol": shown[0]}
            await send(message)

        return echoing


def _hashed(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sending


def _answering(scope: Scope, receive: Receive, send: Send) -> Send:
    """A WebSocket that the application closes before accepting it (there is none at this path) gets a document."""
    accepted = False

    async def sending(message: Message) -> None:
        nonlocal accepted
        if message["type"] == "websocket.close" and not accepted:
            detail = message.get("reason") or f"there is no WebSocket at {scope['path']}"
            problem = Problem(
                404, detail, field="path", value=scope["path"], remedy="the streams are in docs/stream.md"
            )
            await problems.refuse(problem, scope, receive, send)
            return
        accepted = accepted or message["type"] == "websocket.accept"
        await send(message)

    return sending
