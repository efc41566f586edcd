"""WebSockets: they may idle, their handshakes may not hang, their messages come whole."""

from __future__ import annotations

import contextlib
import time
from contextlib import ExitStack

import pytest
from peers import HOST, SHORT, Peer, parsed, stub, until
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

UPGRADE = (
    b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
)


def opened(app):
    return connect(f"ws://127.0.0.1:{app.port}/socket", compression=None)


def test_a_websocket_may_idle_longer_than_anything_else(app):
    with opened(app) as socket:
        until(lambda: app.guard.counts()["websocket"] == 1)
        time.sleep(2.5 * max(SHORT["header_seconds"], SHORT["body_seconds"], SHORT["keep_alive_seconds"]))
        socket.send("still here")
        assert socket.recv() == "still here"
    until(lambda: app.guard.counts()["websocket"] == 0)


def test_a_websocket_counts_as_a_connection_and_gives_its_place_back():
    with stub(max_connections_per_peer=4) as app:
        for _ in range(3):
            with ExitStack() as stack:
                for _ in range(4):
                    stack.enter_context(opened(app))
                with Peer(app.port) as peer:
                    peer.send(b"GET /echo HTTP/1.1\r\n" + HOST + b"\r\n")
                    assert parsed(peer.rest())[0] == 429
            until(lambda: app.guard.counts()["websocket"] == 0)


HANDSHAKES = {
    "a long line": b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"X: " + b"a" * 8200 + b"\r\n\r\n",
    "another method": b"PUT /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"\r\n",
    "no key": b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE.partition(b"Sec-WebSocket-Key")[0] + b"\r\n",
    "letters beyond ASCII": b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"X: \xc3\xa4\x80\r\n\r\n",
}


@pytest.mark.parametrize("name", HANDSHAKES)
def test_a_handshake_that_cannot_be_is_answered_and_ends(name):
    with stub(header_kb=16) as app, Peer(app.port) as peer:
        peer.send(HANDSHAKES[name])
        if name == "letters beyond ASCII" and peer.answer()[0] == 101:
            return  # they are taken as Latin-1
        if name != "letters beyond ASCII":
            assert 400 <= parsed(peer.rest())[0] < 500
        until(lambda: sum(app.guard.counts().values()) == 0)


def test_a_handshake_behind_an_unanswered_request_is_refused(app):
    with Peer(app.port) as peer:
        peer.send(b"GET /late HTTP/1.1\r\n" + HOST + b"\r\nGET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"\r\n")
        answer = peer.rest()
    assert answer.count(b"HTTP/1.1 ") == 1
    assert parsed(answer)[0] == 200


@pytest.mark.parametrize("size", [1, 100, 10_000])
def test_fragments_are_put_together(app, size):
    message = "".join(chr(97 + number % 26) for number in range(40 * size))
    with opened(app) as socket:
        socket.send(message[at : at + size] for at in range(0, len(message), size))
        assert socket.recv() == message


def test_a_message_that_is_too_large_is_told_so_while_it_is_sent(app):
    for _ in range(5):
        with opened(app) as socket:
            with contextlib.suppress(ConnectionClosed):  # it may hear of it while it sends
                socket.send(bytes((16 << 20) + 1))
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv()
            assert closed.value.rcvd.code == 1009
    until(lambda: sum(app.guard.counts().values()) == 0)


def test_a_peer_that_sends_pings_and_reads_nothing_is_ended(app):
    with Peer(app.port, receive_buffer=4096) as peer:
        peer.send(b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"\r\n")
        until(lambda: app.guard.counts()["websocket"] == 1)
        ping = b"\x89\xfd" + bytes(4) + b"p" * 125
        assert peer.flood(ping * 500, 256 << 20) < 256 << 20
        until(lambda: app.guard.counts()["websocket"] == 0)
