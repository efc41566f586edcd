"""Relay of a WebSocket to the peer that owns its scene, with messages in both directions and close codes."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

from starlette.types import Receive, Scope, Send
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.typing import Subprotocol

from server import problems
from server.background import run_until_first
from server.connections.websocket import limit_messages
from server.peers.peers import CONNECT_S, SILENT_S, unreachable_problem
from server.problems import Problem

SWITCHED = 101
"""HTTP status of an accepted handshake."""
RESTARTS, ABNORMAL = 1012, 1006
"""Close codes: the service is restarting; the connection ended without a close frame (never sent on the wire)."""


async def proxy_websocket(
    address: str,
    scene: str,
    headers: Mapping[str, str],
    most_bytes: int,
    scope: Scope,
    receive: Receive,
    send: Send,
) -> int:
    """Relays messages until either end closes, and returns the HTTP status of the peer's handshake response.

    Args:
        address: URL of the WebSocket at the peer, `http://…`.
        scene: scene id.
        headers: headers for the request to the peer.
        most_bytes: maximum size in bytes of a message from the client.
        scope: ASGI scope of the client's WebSocket.
        receive: ASGI `receive` callable of the client's WebSocket.
        send: ASGI `send` callable of the client's WebSocket.

    Raises:
        Problem: 503 if the peer does not respond.
    """
    try:
        peer = await connect(
            f"ws{address.removeprefix('http')}",
            sock=await asyncio.wait_for(_connect(address), CONNECT_S),
            subprotocols=[Subprotocol(name) for name in scope["subprotocols"]] or None,
            additional_headers=headers,
            user_agent_header=None,
            compression=None,
            max_size=None,  # the client's request bounds the size of the peer's messages
            max_queue=1,  # lets the peer notice a slow client and send it only the newest messages
            open_timeout=SILENT_S,  # the peer may have to wake the scene first
            proxy=None,
        )
    except InvalidStatus as refused:
        await _refuse_handshake(refused, scope, receive, send)
        return refused.response.status_code
    except (OSError, TimeoutError, WebSocketException):
        raise unreachable_problem(scene) from None
    limit_messages(scope, most_bytes)
    async with peer:
        assert (await receive())["type"] == "websocket.connect"
        await send({"type": "websocket.accept", "subprotocol": peer.subprotocol})
        await run_until_first(_to_peer(peer, receive), _from_peer(peer, send))
    return SWITCHED


async def _connect(address: str) -> socket.socket:
    """Returns a TCP socket connected to the peer.

    Connecting separately allows a short timeout for an unreachable machine and a long one for a busy service.
    """
    where = urlsplit(address)
    assert where.hostname is not None
    family = socket.AF_INET6 if ":" in where.hostname else socket.AF_INET
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        made.setblocking(False)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        await asyncio.get_running_loop().sock_connect(made, (where.hostname, where.port or 80))
    except BaseException:
        made.close()
        raise
    return made


async def _to_peer(peer: ClientConnection, receive: Receive) -> None:
    while (message := await receive())["type"] == "websocket.receive":
        text = message.get("text")
        with contextlib.suppress(ConnectionClosed):  # `_from_peer` notifies the client
            await peer.send(message["bytes"] if text is None else text)
    code = message.get("code") or RESTARTS
    await peer.close(code if _may_be_sent(code) else RESTARTS, message.get("reason") or "")


async def _from_peer(peer: ClientConnection, send: Send) -> None:
    with contextlib.suppress(ConnectionClosed):
        while True:
            message = await peer.recv()
            await send({"type": "websocket.send", "text" if isinstance(message, str) else "bytes": message})
    code = peer.close_code or ABNORMAL
    reason = peer.close_reason or ""
    await send({"type": "websocket.close", "code": code if _may_be_sent(code) else RESTARTS, "reason": reason})


def _may_be_sent(code: int) -> bool:
    """Returns whether a close code may be sent on the wire; some codes are for local use only (RFC 6455, 7.4)."""
    return 1000 <= code < 5000 and code not in (1004, 1005, ABNORMAL, 1015)


async def _refuse_handshake(refused: InvalidStatus, scope: Scope, receive: Receive, send: Send) -> None:
    """Responds to the client's handshake with the response of the peer."""
    answer = refused.response
    if "websocket.http.response" not in scope.get("extensions", {}):
        problem = Problem(
            answer.status_code,
            "the service that owns the scene refused the connection",
            remedy="request GET /v1/scenes/ID to see the reason",
        )
        await problems.refuse(problem, scope, receive, send)
        return
    kept = ("content-type", "retry-after", "www-authenticate")
    headers = [
        (name.lower().encode(), value.encode()) for name, value in answer.headers.raw_items() if name.lower() in kept
    ]
    await send({"type": "websocket.http.response.start", "status": answer.status_code, "headers": headers})
    await send({"type": "websocket.http.response.body", "body": answer.body})
