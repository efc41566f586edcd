"""Passes requests and WebSockets of a scene that a peer has on to it; the client does not notice."""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import AsyncIterator, Callable, Iterator

import httpx
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from server import problems
from server.http.permissions import PERMISSION
from server.peers.peers import PASSED, Peers, unreachable
from server.peers.websocket_proxy import proxy_websocket
from server.problems import Problem

OF_A_SCENE = re.compile(r"/v1/scenes/([0-9a-f]{12})(?:/.*)?")
"""Addresses that are passed on. Others are answered here: no peer is asked for what cannot be a scene."""
HOP_BY_HOP = frozenset(
    {b"connection", b"keep-alive", b"proxy-authenticate", b"proxy-authorization", b"proxy-connection", b"te"}
    | {b"trailer", b"transfer-encoding", b"upgrade"}
)
"""Headers between two ends of one connection (RFC 9110, 7.6.1)."""
KEPT_HERE = HOP_BY_HOP | {b"authorization", b"cookie", b"expect", b"forwarded", b"host", b"origin", b"referer"}
"""Headers of a request that this service has looked at: it asks the peer in its own name."""
OF_THE_SERVER = frozenset({b"date", b"server"})
"""Headers of an answer that the server of this service writes itself."""

NOT_FOUND = 404

log = logging.getLogger("scas4d.server")


class ProxyMiddleware:
    """Middleware; behind authentication, and before all that looks at bodies.

    Args:
        peers: once the service has them. has: whether this service has a scene.
        most_bytes: of a message that a client sends over a WebSocket.
    """

    def __init__(self, app: ASGIApp, peers: Callable[[], Peers], has: Callable[[str], bool], most_bytes: int) -> None:
        self.app = app
        self._siblings = peers
        self._has = has
        self._most_bytes = most_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answers from a peer where that has the scene, else by this service."""
        scene = self._scene_elsewhere(scope)
        if scene is None:
            await self.app(scope, receive, send)
            return
        peers = self._siblings()
        try:
            owner = await peers.owner(scene)
            if owner is None:
                await self.app(scope, receive, send)
            elif scope["type"] == "websocket":
                headers = peers.headers(scope[PERMISSION])
                status = await proxy_websocket(
                    address(owner, scope), scene, headers, self._most_bytes, scope, receive, send
                )
                if status == NOT_FOUND:
                    await peers.check(owner, scene)
            else:
                await self._pass(peers, owner, scene, scope, receive, send)
        except Problem as problem:
            await problems.refuse(problem, scope, receive, send)

    def _scene_elsewhere(self, scope: Scope) -> str | None:
        """Returns the scene that is asked for, if this service does not have it and may pass the request on."""
        of = OF_A_SCENE.fullmatch(scope["path"]) if scope["type"] in ("http", "websocket") else None
        if of is None or PERMISSION not in scope or PASSED in Headers(scope=scope) or self._has(of[1]):
            return None
        dots = any(part in (".", "..") for part in scope["path"].split("/"))  # a client of HTTP takes them out
        return None if dots else of[1]

    async def _pass(self, peers: Peers, owner: str, scene: str, scope: Scope, receive: Receive, send: Send) -> None:
        names = Headers(scope=scope)
        body = _Body(receive, there="content-length" in names or "transfer-encoding" in names)
        headers = [*_passed(scope), *((n.encode(), v.encode()) for n, v in peers.headers(scope[PERMISSION]).items())]
        request = httpx.Request(
            scope["method"],
            address(owner, scope),
            headers=headers,
            content=body.parts() if body.there else None,
        )
        answering = asyncio.ensure_future(_answer(peers.client, request, owner, scene, send))
        leaving = asyncio.ensure_future(body.hung_up())
        try:
            await asyncio.wait({answering, leaving}, return_when=asyncio.FIRST_COMPLETED)
            if answering.done() and answering.result() == NOT_FOUND:  # the scene, or something in it
                await peers.check(owner, scene)
        finally:
            for task in (answering, leaving):
                task.cancel()
            await asyncio.gather(answering, leaving, return_exceptions=True)


class _Body:
    """The body of a request as it comes, and whether its client has hung up since."""

    def __init__(self, receive: Receive, *, there: bool) -> None:
        self.there = there
        self._receive = receive
        self._is_read = asyncio.Event()

    async def parts(self) -> AsyncIterator[bytes]:
        """Yields the body.

        Raises:
            httpx.RequestError: the client has hung up; the peer sees a body that ends early.
        """
        while True:
            message = await self._receive()
            if message["type"] == "http.disconnect":
                raise httpx.RequestError("the client has hung up")
            yield message.get("body", b"")
            if not message.get("more_body"):
                break
        self._is_read.set()

    async def hung_up(self) -> None:
        """Returns once the client has hung up; a body is read by `parts` first."""
        if self.there:
            await self._is_read.wait()
        while (await self._receive())["type"] != "http.disconnect":
            pass


async def _answer(client: httpx.AsyncClient, request: httpx.Request, owner: str, scene: str, send: Send) -> int:
    """Sends a request and hands its answer on; returns the status.

    Raises:
        Problem: 503, the peer does not answer.
    """
    try:
        answer = await client.send(request, stream=True)
    except httpx.HTTPError:
        raise unreachable(scene) from None
    try:
        headers = [
            (name, value.removeprefix(owner.encode()) if name.lower() == b"location" else value)
            for name, value in answer.headers.raw
            if name.lower() not in HOP_BY_HOP | OF_THE_SERVER
        ]
        await send({"type": "http.response.start", "status": answer.status_code, "headers": headers})
        async for part in answer.aiter_raw():
            await send({"type": "http.response.body", "body": part, "more_body": True})
        await send({"type": "http.response.body", "body": b""})
    except httpx.HTTPError as error:  # the client sees a body that ends early
        log.warning("the answer of %s ended early: %s: %s", owner, type(error).__name__, error)
    finally:
        await answer.aclose()
    return answer.status_code


def _passed(scope: Scope) -> Iterator[tuple[bytes, bytes]]:
    """Yields the headers of a request that go on, byte by byte as they came."""
    named = {part.strip() for name, value in scope["headers"] if name == b"connection" for part in value.split(b",")}
    asks = False
    for name, value in scope["headers"]:
        asks = asks or name == b"accept-encoding"
        own = name in KEPT_HERE or name in {part.lower() for part in named}
        if not (own or name.startswith((b"sec-", b"x-forwarded-"))):
            yield name, value
    if not asks:
        yield b"accept-encoding", b"identity"


def address(peer: str, scope: Scope) -> str:
    """Returns what was asked, at a peer; percent-encoded as it was sent."""
    path = scope.get("raw_path", scope["path"].encode()).decode("latin-1").partition("?")[0]
    query = scope.get("query_string", b"").decode("latin-1")
    return f"{peer}{path}?{query}" if query else f"{peer}{path}"
