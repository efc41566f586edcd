"""Authentication of requests and WebSockets by tokens, tickets and share links.

The service's token grants full access. A read-only token grants read access until the token
expires, either to all scenes or, as part of a share link, to one scene. Read-only tokens are signed
with the service's token and are not stored. Changing the service's token revokes all of them.
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
from server.http.tickets import SUBPROTOCOL, Tickets, accept_subprotocol, take_offered
from server.problems import Problem
from server.settings import ServerSettings, is_loopback

PROBES = frozenset({"/health/live", "/health/ready", "/health/ingest"})
"""Paths that orchestrators probe without a token; the responses reveal at most the number of scenes."""
OPEN = PROBES | {"/", "/viewer", "/favicon.ico", "/docs", "/redoc", "/openapi.json"}
"""Paths that expose no data and need no token: the probes, the viewer page and the API description."""
OPEN_FOLDERS = ("/viewer/", "/docs/")
"""Path prefixes of the viewer's and the API reference's files, which need no token."""
IN_URL = frozenset({"token", "access_token", "api_key", "ticket", "authorization"})
"""Query parameters that are rejected because their values may be secrets."""

HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Default headers of every response.

They prevent framing by other sites, media type sniffing by browsers, and outdated responses from caches.
"""


class AuthMiddleware:
    """Middleware that authenticates requests and WebSockets.

    Unauthorized requests get a problem document.
    """

    def __init__(self, app: ASGIApp, settings: ServerSettings, tickets: Tickets) -> None:
        self.app = app
        self.hosts = settings.allowed_hosts
        self.origins = settings.allowed_origins
        self.tickets = tickets
        secret = settings.secret
        self._token = None if secret is None else _hash(secret)
        self._sharing = None if secret is None else Sharing(secret)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes the request on if it is authorized; otherwise responds with a problem document."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        sending = _add_headers(send) if scope["type"] == "http" else _answer_closed_handshake(scope, receive, send)
        try:
            self._check_reachable(scope)
            check_origin(scope, self.hosts, self.origins)
            _refuse_control_characters(scope)
            self._refuse_token_in_url(scope)
            if scope["type"] == "websocket":
                sending = self._ticket(scope, sending)
            elif not self._is_open(scope):
                self._permit(self._bearer(scope), scope)
        except Problem as problem:
            await problems.refuse(problem, scope, receive, sending)
            return
        await self.app(scope, receive, sending)

    def _check_reachable(self, scope: Scope) -> None:
        """Checks that a service without a token is used only from this machine, directly or through a local proxy."""
        ends = [scope[end][0] for end in ("server", "client") if scope.get(end)]
        if self._token is None and not all(map(is_loopback, ends)):
            raise Problem(
                403,
                "the service is reachable from other machines but has no token",
                field="SCAS4D_TOKEN",
                remedy="set a token and restart the service, or listen on 127.0.0.1",
            )

    def _refuse_token_in_url(self, scope: Scope) -> None:
        query = scope.get("query_string", b"").decode("latin-1")
        for name, _ in parse_qsl(query, keep_blank_values=True):
            if name.lower() in IN_URL:
                raise Problem(
                    400,
                    "secrets must not be sent in URLs, because URLs end up in logs and browser histories",
                    field=name,
                    remedy="send the token as `Authorization: Bearer`, or a ticket as a WebSocket subprotocol; if this "
                    "was a real secret, replace it",
                )

    def _is_open(self, scope: Scope) -> bool:
        path = scope["path"]
        # A CORS preflight uses OPTIONS without a token; its Origin was checked above.
        return path in OPEN or path.startswith(OPEN_FOLDERS) or (scope["method"] == "OPTIONS" and bool(self.origins))

    def _bearer(self, scope: Scope) -> Permission:
        """Returns the permission granted by the request's token.

        Raises:
            Problem: 401 if the token is missing, invalid or expired.
        """
        if self._token is None or self._sharing is None:
            return ALL
        given = Headers(scope=scope).getlist("authorization")
        scheme, _, token = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        if scheme.lower() == "bearer":
            if hmac.compare_digest(_hash(token.strip()), self._token):  # the hash hides the length
                return ALL
            if (permission := self._sharing.read(token.strip())) is not None:
                return permission
        raise Problem(
            401,
            "the token is invalid" if given else "the service requires a token",
            field="Authorization",
            remedy="send the service's token as `Authorization: Bearer`",
            headers={"WWW-Authenticate": 'Bearer realm="scas4d"' + (', error="invalid_token"' if given else "")},
        )

    def _permit(self, permission: Permission, scope: Scope) -> None:
        if permission != ALL:
            check(permission, scope)
        scope[PERMISSION] = permission

    def _ticket(self, scope: Scope, send: Send) -> Send:
        """Checks the ticket or token of a WebSocket; returns a `send` that accepts the ticket's subprotocol."""
        shown = take_offered(scope)
        if self._token is not None and len(shown) == 1:
            permission = self.tickets.redeem(shown[0].removeprefix(SUBPROTOCOL))
            if permission is None:
                raise Problem(
                    401,
                    "the ticket was already used, has expired, or was never issued",
                    field="Sec-WebSocket-Protocol",
                    remedy="request a new one with POST /v1/tickets and use it immediately",
                    headers={"WWW-Authenticate": 'Bearer realm="scas4d"'},
                )
        else:
            permission = self._bearer(scope)
        self._permit(permission, scope)
        return accept_subprotocol(shown[0], send) if shown else send


def _refuse_control_characters(scope: Scope) -> None:
    """Rejects control characters in a path.

    A route pattern may match a path that ends with a line break even if a permission rule does not.
    """
    if any(character < " " or character == "\x7f" for character in scope["path"]):
        raise Problem(
            400,
            "the path contains a control character",
            field="path",
            value=scope["path"],
            remedy="see /openapi.json for all paths",
        )


def _hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogateescape")).digest()


def _add_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
        await send(message)

    return sending


def _answer_closed_handshake(scope: Scope, receive: Receive, send: Send) -> Send:
    """Wraps `send` to respond with a 404 problem if the application closes a WebSocket before accepting it.

    Closing it that early means that the path has no WebSocket endpoint.
    """
    accepted = False

    async def sending(message: Message) -> None:
        nonlocal accepted
        if message["type"] == "websocket.close" and not accepted:
            detail = message.get("reason") or f"no WebSocket endpoint at {scope['path']}"
            problem = Problem(
                404, detail, field="path", value=scope["path"], remedy="see docs/stream.md for the endpoints"
            )
            await problems.refuse(problem, scope, receive, send)
            return
        accepted = accepted or message["type"] == "websocket.accept"
        await send(message)

    return sending
