"""Middlewares of every request and every WebSocket: the access log, authentication, and the size of the body.

Any web page can send requests to a server on the loopback of the machine that shows it. Two headers, which no page can
forge, tell: `Origin` (and `Sec-Fetch-Site`, where a picture or a form leaves Origin out) names the page that asks;
`Host` is the name under which the service was found, and a name that is not ours was pointed at this machine (DNS
rebinding), which makes the foreign page look like one of the service itself.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import time
from collections.abc import Sequence
from urllib.parse import parse_qsl, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server import problems
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
DEFAULT_PORTS = {"http": 80, "https": 443, "ws": 80, "wss": 443}

access = logging.getLogger("scas4d.access")


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


class AuthMiddleware:
    """Authenticates requests and WebSockets; refuses others with a problem document."""

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
            check_origin(scope, self.hosts, self.origins)
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

    def _bearer(self, scope: Scope) -> None:
        if self._token is None:
            return
        given = Headers(scope=scope).getlist("authorization")
        scheme, _, token = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        right = hmac.compare_digest(_hashed(token.strip()), self._token)  # hashed first: the length tells nothing
        if scheme.lower() != "bearer" or not right:
            raise Problem(
                401,
                "the token is wrong" if given else "the service requires a token",
                field="Authorization",
                remedy="send `Authorization: Bearer` and the token that the service was started with",
                headers={"WWW-Authenticate": 'Bearer realm="scas4d"' + (', error="invalid_token"' if given else "")},
            )

    def _ticket(self, scope: Scope, send: Send) -> Send:
        """Checks the ticket of a WebSocket, or its token; returns the sender that accepts it."""
        shown = take_offered(scope)
        if self._token is not None:
            if len(shown) == 1:
                if not self.tickets.redeem(shown[0].removeprefix(SUBPROTOCOL)):
                    raise Problem(
                        401,
                        "the ticket is used, too old, or was never issued",
                        field="Sec-WebSocket-Protocol",
                        remedy="fetch another with POST /v1/tickets and use it at once",
                        headers={"WWW-Authenticate": 'Bearer realm="scas4d"'},
                    )
            else:
                self._bearer(scope)
        return accepting(shown[0], send) if shown else send


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


def check_origin(scope: Scope, allowed_hosts: Sequence[str], allowed_origins: Sequence[str]) -> None:
    """Checks Host and Origin of a request.

    Args:
        scope: of ASGI, http or websocket.
        allowed_hosts: names (`host` or `host:port`) besides the loopback's and the address that was connected to.
        allowed_origins: of other sites, `scheme://host[:port]`.

    Raises:
        Problem: 400 without a Host that can be read, 421 for a Host that is not ours, 403 for a foreign page.
    """
    headers = Headers(scope=scope)
    host = _the_host(headers)
    if not _is_ours(scope, host, allowed_hosts):
        raise Problem(
            421,
            "the service does not go by this name",
            field="Host",
            value=host,
            remedy="address it as 127.0.0.1 or localhost, or add the name to SCAS4D_ALLOWED_HOSTS",
        )
    origin = headers.get("origin")
    if origin is not None:
        if not (_same(origin, host) or origin.lower() in {name.lower() for name in allowed_origins}):
            raise _foreign("Origin", origin)
        return
    site = headers.get("sec-fetch-site", "none")
    opened = headers.get("sec-fetch-mode") == "navigate" and scope.get("method") in ("GET", "HEAD")
    framed = headers.get("sec-fetch-dest", "document") != "document"
    if site not in ("none", "same-origin") and (not opened or framed):
        raise _foreign("Sec-Fetch-Site", site)


def _foreign(field: str, value: str) -> Problem:
    return Problem(
        403,
        "pages of other sites may not use the service",
        field=field,
        value=value,
        remedy="use the service's own page, or add the site to SCAS4D_ALLOWED_ORIGINS",
    )


def _the_host(headers: Headers) -> str:
    hosts = headers.getlist("host")
    if len(hosts) != 1 or split(hosts[0]) is None:
        raise Problem(
            400,
            "a request has one Host header, host or host:port",
            field="Host",
            value=", ".join(hosts),
            remedy="send the address that you connect to",
        )
    return hosts[0]


def split(authority: str) -> tuple[str, int | None] | None:
    """Splits `host[:port]` into host (lower case, IPv6 without brackets, no final dot) and port, if it can."""
    try:
        parts = urlsplit(f"//{authority}")
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    if not host or parts.netloc != authority or parts.username is not None or parts.path or parts.query:
        return None
    return host.rstrip("."), port


def _is_ours(scope: Scope, authority: str, allowed: Sequence[str]) -> bool:
    found = split(authority)
    assert found is not None
    host, port = found
    if is_loopback(host) or (scope.get("server") and _is_address(host) and host == scope["server"][0]):
        return True
    return any(other is not None and other[0] == host and other[1] in (None, port) for other in map(split, allowed))


def _is_address(host: str) -> bool:
    try:
        return bool(ipaddress.ip_address(host))
    except ValueError:
        return False


def _same(origin: str, authority: str) -> bool:
    """Returns True if the page comes from the request's host and port; a proxy with TLS changes the scheme."""
    scheme, _, rest = origin.partition("://")
    page, asked = split(rest), split(authority)
    default = DEFAULT_PORTS.get(scheme.lower())
    if page is None or asked is None or default is None:
        return False
    return (page[0], page[1] or default) == (asked[0], asked[1] or default)
