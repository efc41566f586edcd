"""Raw connections to a service, and a small application under the guard of the real one."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from contextlib import contextmanager

import uvicorn
from starlette.applications import Starlette
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, StreamingResponse
from starlette.routing import Route, WebSocketRoute
from waiting import HANG_S, wait_for

from server.connections.client_limit import ClientLimit
from server.connections.config import uvicorn_config
from server.connections.guard import ConnectionGuard, ConnectionLimits
from server.connections.websocket import limit_messages
from server.settings import ServerSettings

LARGE_MB = 16
SHORT = dict(header_seconds=0.8, body_seconds=0.8, keep_alive_seconds=1.2, unread_seconds=0.8, header_kb=8)
HOST = b"Host: 127.0.0.1\r\n"
GET = b"GET /echo HTTP/1.1\r\n" + HOST


def put(path, length=None, *more):
    kind = b"Transfer-Encoding: chunked" if length is None else b"Content-Length: %d" % length
    return b"PUT %s HTTP/1.1\r\n" % path + HOST + b"".join(line + b"\r\n" for line in (kind, *more)) + b"\r\n"


def drip(peer, piece):
    """Sends a piece every tenth of a second until the service has had enough."""
    until = time.monotonic() + HANG_S
    while True:
        assert time.monotonic() < until
        try:
            peer.send(piece)
        except OSError:
            return
        time.sleep(0.1)


class Peer:
    """A connection of which every byte is ours."""

    def __init__(self, port, receive_buffer=None, source=None):
        self.socket = socket.socket()
        if source is not None:
            self.socket.bind((source, 0))
        if receive_buffer is not None:
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive_buffer)
        self.socket.settimeout(HANG_S)
        self.socket.connect(("127.0.0.1", port))

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def send(self, *pieces):
        for piece in pieces:
            self.socket.sendall(piece)

    def flood(self, piece, most):
        """Sends a piece again and again until the service has enough; bytes that the system took."""
        sent = 0
        try:
            while sent < most:
                sent += self.socket.send(piece)
        except OSError:
            pass
        return sent

    def rest(self):
        """All that comes until the service closes the connection."""
        found = b""
        try:
            while piece := self.socket.recv(1 << 16):
                found += piece
        except ConnectionError:
            pass
        return found

    def answer(self):
        """One answer: status, headers, body."""
        found = b""
        while b"\r\n\r\n" not in found:
            piece = self.socket.recv(1)
            assert piece, found
            found += piece
        head, headers = parsed(found)
        body = b""
        while len(body) < int(headers.get("content-length", 0)):
            piece = self.socket.recv(int(headers["content-length"]) - len(body))
            assert piece
            body += piece
        return head, headers, body


def parsed(head):
    first, *lines = head.partition(b"\r\n\r\n")[0].decode().split("\r\n")
    return int(first.split()[1]), dict((line.lower().split(": ", 1)) for line in lines)


def refused(answer, status, field):
    """The problem document of a refusal, read until the connection was closed."""
    found, headers = parsed(answer)
    assert found == status, answer
    assert headers["connection"] == "close"
    assert headers["content-type"] == "application/problem+json"
    document = json.loads(answer.partition(b"\r\n\r\n")[2])
    assert (document["status"], document["field"]) == (status, field)
    assert document["remedy"]
    return document


class Stub:
    """What the application saw."""

    def __init__(self):
        self.seen = []
        self.disconnected = 0
        self.go = threading.Event()

    async def echo(self, request):
        self.seen.append(request.url.path)
        try:
            body = await request.body()
        except ClientDisconnect:
            return JSONResponse({}, 400)
        client = request.client.host
        return JSONResponse({"length": len(body), "sum": sum(body), "client": client, "path": request.url.path})

    async def late(self, request):
        await asyncio.sleep(1.5 * SHORT["body_seconds"])
        return await self.echo(request)

    async def wait(self, request):
        while not self.go.is_set():
            await asyncio.sleep(0.02)
        return JSONResponse({})

    async def early(self, request):
        """Answers before it has read the body."""
        return JSONResponse({"early": True}, 401)

    async def large(self, request):
        async def pieces():
            for _ in range(LARGE_MB):
                yield bytes(1 << 20)

        return StreamingResponse(pieces())

    async def feed(self, websocket):
        """Sends faster than anybody reads, and takes note of what comes."""

        async def send():
            while True:
                await websocket.send_bytes(bytes(16 << 10))

        await websocket.accept()
        sending = asyncio.create_task(send())
        try:
            async for text in websocket.iter_text():
                self.seen.append(text)
        finally:
            sending.cancel()

    async def socket(self, websocket):
        limit_messages(websocket.scope, 1 << 24)
        await websocket.accept()
        async for text in websocket.iter_text():
            await websocket.send_text(text)


@contextmanager
def stub(uvicorn_options=None, **changes):
    """A small application under the guard: its port, what it saw, its guard."""
    settings = ServerSettings(**{**SHORT, **changes})
    seen = Stub()
    names = ("echo", "late", "wait", "early", "large")
    routes = [Route(f"/{name}", getattr(seen, name), methods=["GET", "PUT", "POST"]) for name in names]
    sockets = [WebSocketRoute(f"/{name}", getattr(seen, name)) for name in ("socket", "feed")]
    app = Starlette(routes=[*routes, *sockets])
    app.state.guard = ConnectionGuard(ConnectionLimits.of(settings))
    if settings.trusted_proxies:
        app.add_middleware(ClientLimit, guard=app.state.guard)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        seen.port = listening.getsockname()[1]
        seen.guard = app.state.guard
        config = uvicorn_config(app, log_level="error", timeout_graceful_shutdown=1, **(uvicorn_options or {}))
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()
        wait_for(lambda: server.started)
        try:
            yield seen
        finally:
            seen.go.set()
            server.should_exit = True
            thread.join(HANG_S)
