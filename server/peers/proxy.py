"""Transparent forwarding of requests and WebSockets to the peer that owns their scene."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import AsyncIterator, Callable, Iterator

import httpx
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from server import problems
from server.background import run_until_first
from server.http.permissions import PERMISSION
from server.peers.peers import PROXIED_HEADER, Peers, unreachable_problem
from server.peers.websocket_proxy import proxy_websocket
from server.problems import Problem

SCENE_PATHS = re.compile(r"/v1/scenes/([0-9a-f]{12})(?:/.*)?")
"""Pattern of the paths that are forwarded; it matches valid scene ids only, so peers are not asked for invalid ones."""
HOP_BY_HOP = frozenset(
    {b"connection", b"keep-alive", b"proxy-authenticate", b"proxy-authorization", b"proxy-connection", b"te"}
    | {b"trailer", b"transfer-encoding", b"upgrade"}
)
"""Hop-by-hop headers, which apply to one connection only (RFC 9110, 7.6.1)."""
REQUEST_HEADERS_DROPPED = HOP_BY_HOP | {
    b"authorization",
    b"cookie",
    b"expect",
    b"forwarded",
    b"host",
    b"origin",
    b"referer",
}
"""Request headers that are not forwarded because this service has already evaluated them."""
RESPONSE_HEADERS_DROPPED = frozenset({b"date", b"server"})
"""Response headers that are not forwarded because this service's own server sets them."""

NOT_FOUND = 404

log = logging.getLogger("scas4d.server")


class ProxyMiddleware:
    """Middleware that forwards requests to peers.

    It runs after authentication and before any middleware that reads bodies.

    Args:
        app: next application in the middleware stack.
        peers: function that returns the peers; called only after the service has started.
        has: function that returns whether this service owns a scene.
        most_bytes: maximum size in bytes of a WebSocket message from a client.
    """

    def __init__(self, app: ASGIApp, peers: Callable[[], Peers], has: Callable[[str], bool], most_bytes: int) -> None:
        self.app = app
        self._peers = peers
        self._has = has
        self._most_bytes = most_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forwards the request if a peer owns its scene; otherwise passes it to the next application."""
        scene = self._remote_scene(scope)
        if scene is None:
            await self.app(scope, receive, send)
            return
        peers = self._peers()
        try:
            owner = await peers.owner(scene)
            if owner is None:
                await self.app(scope, receive, send)
            elif scope["type"] == "websocket":
                headers = peers.headers(scope[PERMISSION])
                status = await proxy_websocket(
                    peer_url(owner, scope), scene, headers, self._most_bytes, scope, receive, send
                )
                if status == NOT_FOUND:
                    await peers.check(owner, scene)
            else:
                await self._forward(peers, owner, scene, scope, receive, send)
        except Problem as problem:
            await problems.refuse(problem, scope, receive, send)

    def _remote_scene(self, scope: Scope) -> str | None:
        """Returns the id of the requested scene if the request may be forwarded, otherwise None.

        A request may be forwarded if this service does not own the scene and the request did not come from a peer.
        """
        of = SCENE_PATHS.fullmatch(scope["path"]) if scope["type"] in ("http", "websocket") else None
        if of is None or PERMISSION not in scope or PROXIED_HEADER in Headers(scope=scope) or self._has(of[1]):
            return None
        dots = any(part in (".", "..") for part in scope["path"].split("/"))  # the HTTP client would normalize the path
        return None if dots else of[1]

    async def _forward(self, peers: Peers, owner: str, scene: str, scope: Scope, receive: Receive, send: Send) -> None:
        names = Headers(scope=scope)
        body = _Body(receive, there="content-length" in names or "transfer-encoding" in names)
        headers = [
            *_forwarded_headers(scope),
            *((n.encode(), v.encode()) for n, v in peers.headers(scope[PERMISSION]).items()),
        ]
        request = httpx.Request(
            scope["method"],
            peer_url(owner, scope),
            headers=headers,
            content=body.parts() if body.there else None,
        )
        answering, _ = await run_until_first(
            _forward_request(peers.client, request, owner, scene, send), body.hung_up()
        )
        if answering is not None and answering.result() == NOT_FOUND:  # of the scene or of a resource in it
            await peers.check(owner, scene)


class _Body:
    """Streamed request body that also detects when the client disconnects."""

    def __init__(self, receive: Receive, *, there: bool) -> None:
        self.there = there
        self._receive = receive
        self._is_read = asyncio.Event()

    async def parts(self) -> AsyncIterator[bytes]:
        """Yields the body in parts.

        Raises:
            httpx.RequestError: the client has disconnected, so the peer receives an incomplete body.
        """
        while True:
            message = await self._receive()
            if message["type"] == "http.disconnect":
                raise httpx.RequestError("the client closed the connection")
            yield message.get("body", b"")
            if not message.get("more_body"):
                break
        self._is_read.set()

    async def hung_up(self) -> None:
        """Waits until `parts` has read the body and then until the client disconnects."""
        if self.there:
            await self._is_read.wait()
        while (await self._receive())["type"] != "http.disconnect":
            pass


async def _forward_request(
    client: httpx.AsyncClient, request: httpx.Request, owner: str, scene: str, send: Send
) -> int:
    """Sends a request to a peer, forwards the response, and returns its status.

    Raises:
        Problem: 503 if the peer does not respond.
    """
    try:
        answer = await client.send(request, stream=True)
    except httpx.HTTPError:
        raise unreachable_problem(scene) from None
    try:
        headers = [
            (name, value.removeprefix(owner.encode()) if name.lower() == b"location" else value)
            for name, value in answer.headers.raw
            if name.lower() not in HOP_BY_HOP | RESPONSE_HEADERS_DROPPED
        ]
        await send({"type": "http.response.start", "status": answer.status_code, "headers": headers})
        async for part in answer.aiter_raw():
            await send({"type": "http.response.body", "body": part, "more_body": True})
        await send({"type": "http.response.body", "body": b""})
    except httpx.HTTPError as error:  # the client receives an incomplete body
        log.warning("the response from %s ended early: %s: %s", owner, type(error).__name__, error)
    finally:
        await answer.aclose()
    return answer.status_code


def _forwarded_headers(scope: Scope) -> Iterator[tuple[bytes, bytes]]:
    """Yields the request headers to forward.

    If the client sent no Accept-Encoding, the header is added with the value `identity`.
    """
    named = {part.strip() for name, value in scope["headers"] if name == b"connection" for part in value.split(b",")}
    asks = False
    for name, value in scope["headers"]:
        asks = asks or name == b"accept-encoding"
        own = name in REQUEST_HEADERS_DROPPED or name in {part.lower() for part in named}
        if not (own or name.startswith((b"sec-", b"x-forwarded-"))):
            yield name, value
    if not asks:
        yield b"accept-encoding", b"identity"


def peer_url(peer: str, scope: Scope) -> str:
    """Returns the URL of a request at a peer, percent-encoded as the client sent it."""
    path = scope.get("raw_path", scope["path"].encode()).decode("latin-1").partition("?")[0]
    query = scope.get("query_string", b"").decode("latin-1")
    return f"{peer}{path}?{query}" if query else f"{peer}{path}"
