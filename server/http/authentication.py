"""Authentication of requests and WebSockets: tokens, tickets, links to share, and what each of them may do.

The token of the service may do everything, the token for reading may read, and a link to share may read one scene until
it ends. A link is signed with the token of the service and kept nowhere: another token ends all links.
"""

from __future__ import annotations

import hashlib
import hmac
from urllib.parse import parse_qsl

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server import problems
from server.http.origin import check_origin
from server.http.permissions import ALL, PERMISSION, Permission, check
from server.http.sharing import Sharing
from server.http.tickets import SUBPROTOCOL, Tickets, accepting, take_offered
from server.problems import Problem
from server.settings import ServerSettings, is_loopback

PROBES = frozenset({"/health/live", "/health/ready", "/health/ingest"})
"""What an orchestrator asks: it has no token, and learns how many scenes there are."""
OPEN = PROBES | {"/", "/viewer", "/favicon.ico", "/docs", "/redoc", "/openapi.json"}
"""Paths that hold no data and need no token: probes, the page that asks for one, and the description of the API."""
OPEN_FOLDERS = ("/viewer/", "/docs/")
"""Files of the viewer's page, and of the API's reference."""
IN_URL = frozenset({"token", "access_token", "api_key", "ticket", "authorization"})

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every answer that has no others: no site shows the service in a frame, no browser guesses another kind of
file, no cache answers with what was true a frame ago."""


class AuthMiddleware:
    """Authenticates requests and WebSockets; refuses others with a problem document."""

    def __init__(self, app: ASGIApp, settings: ServerSettings, tickets: Tickets) -> None:
        self.app = app
        self.hosts = settings.allowed_hosts
        self.origins = settings.allowed_origins
        self.tickets = tickets
        secret = settings.secret
        self._token = None if secret is None else _hashed(secret)
        self._sharing = None if secret is None else Sharing(secret)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on, or answers it."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        sending = _with_headers(send) if scope["type"] == "http" else _answering(scope, receive, send)
        try:
            self._reached(scope)
            check_origin(scope, self.hosts, self.origins)
            _printable(scope)
            self._no_token_in_url(scope)
            if scope["type"] == "websocket":
                sending = self._ticket(scope, sending)
            elif not self._is_open(scope):
                self._permit(self._bearer(scope), scope)
        except Problem as problem:
            await problems.refuse(problem, scope, receive, sending)
            return
        await self.app(scope, receive, sending)

    def _reached(self, scope: Scope) -> None:
        """Without a token only this machine reaches the service, directly or through a trusted proxy on it."""
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

    def _bearer(self, scope: Scope) -> Permission:
        """Returns what the bearer may do."""
        if self._token is None or self._sharing is None:
            return ALL
        given = Headers(scope=scope).getlist("authorization")
        scheme, _, token = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        if scheme.lower() == "bearer":
            if hmac.compare_digest(_hashed(token.strip()), self._token):  # hashed first: the length reveals nothing
                return ALL
            if (permission := self._sharing.read(token.strip())) is not None:
                return permission
        raise Problem(
            401,
            "the token is wrong" if given else "the service requires a token",
            field="Authorization",
            remedy="send `Authorization: Bearer` and the token that the service was started with",
            headers={"WWW-Authenticate": 'Bearer realm="scas4d"' + (', error="invalid_token"' if given else "")},
        )

    def _permit(self, permission: Permission, scope: Scope) -> None:
        if permission != ALL:
            check(permission, scope)
        scope[PERMISSION] = permission

    def _ticket(self, scope: Scope, send: Send) -> Send:
        """Checks the ticket of a WebSocket, or its token; returns the sender that accepts it."""
        shown = take_offered(scope)
        if self._token is not None and len(shown) == 1:
            permission = self.tickets.redeem(shown[0].removeprefix(SUBPROTOCOL))
            if permission is None:
                raise Problem(
                    401,
                    "the ticket is used, too old, or was never issued",
                    field="Sec-WebSocket-Protocol",
                    remedy="fetch another with POST /v1/tickets and use it at once",
                    headers={"WWW-Authenticate": 'Bearer realm="scas4d"'},
                )
        else:
            permission = self._bearer(scope)
        self._permit(permission, scope)
        return accepting(shown[0], send) if shown else send


def _printable(scope: Scope) -> None:
    """Refuses control characters in a path: a route may match before a line's end, and a rule behind it not."""
    if any(character < " " or character == "\x7f" for character in scope["path"]):
        raise Problem(
            400,
            "the path has a control character",
            field="path",
            value=scope["path"],
            remedy="see /openapi.json for the addresses",
        )


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
    """Answers with a document if the application closes a WebSocket before accepting it: none is at the path."""
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
