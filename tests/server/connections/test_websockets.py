"""WebSockets: they may idle, their handshakes may not hang, their messages come whole."""

from __future__ import annotations

import contextlib
import socket
import time
from contextlib import ExitStack

import pytest
from peers import GET, HOST, Peer, parsed, put, refused, stub
from waiting import HANG_S, wait_for
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

UPGRADE = (
    b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
)


def opened(app):
    return connect(f"ws://127.0.0.1:{app.port}/socket", compression=None)


def test_a_websocket_may_idle_longer_than_anything_else(app):
    with opened(app) as client:
        wait_for(lambda: app.guard.counts()["websocket"] == 1)
        with Peer(app.port) as idle, Peer(app.port) as silent, Peer(app.port) as slow:  # opened later, and ended
            idle.send(GET + b"\r\n")
            slow.send(put(b"/echo", 100_000))
            assert idle.answer()[0] == 200
            assert (idle.rest(), silent.rest()) == (b"", b"")
            refused(slow.rest(), 408, "body")
        client.send("still here")
        assert client.recv() == "still here"
    wait_for(lambda: app.guard.counts()["websocket"] == 0)


def test_a_websocket_counts_as_a_connection_and_gives_its_place_back():
    with stub(max_connections_per_peer=4) as app:
        for _ in range(3):
            with ExitStack() as stack:
                for _ in range(4):
                    stack.enter_context(opened(app))
                with Peer(app.port) as peer:
                    peer.send(b"GET /echo HTTP/1.1\r\n" + HOST + b"\r\n")
                    assert parsed(peer.rest())[0] == 429
            wait_for(lambda: app.guard.counts()["websocket"] == 0)


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
        wait_for(lambda: sum(app.guard.counts().values()) == 0)


def test_a_handshake_behind_an_unanswered_request_is_refused(app):
    with Peer(app.port) as peer:
        peer.send(b"GET /late HTTP/1.1\r\n" + HOST + b"\r\nGET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"\r\n")
        answer = peer.rest()
    assert answer.count(b"HTTP/1.1 ") == 1
    assert parsed(answer)[0] == 200


@pytest.mark.parametrize("size", [1, 100, 10_000])
def test_fragments_are_put_together(app, size):
    message = "".join(chr(97 + number % 26) for number in range(40 * size))
    with opened(app) as client:
        client.send(message[at : at + size] for at in range(0, len(message), size))
        assert client.recv() == message


def test_a_message_that_is_too_large_is_told_so_while_it_is_sent(app):
    for _ in range(5):
        with opened(app) as client:
            with contextlib.suppress(ConnectionClosed):  # it may hear of it while it sends
                client.send(bytes((16 << 20) + 1))
            with pytest.raises(ConnectionClosed) as closed:
                client.recv()
            assert closed.value.rcvd.code == 1009
    wait_for(lambda: sum(app.guard.counts().values()) == 0)


def test_a_peer_that_sends_pings_and_reads_nothing_is_ended(app):
    with Peer(app.port, receive_buffer=4096) as peer:
        peer.send(b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"\r\n")
        wait_for(lambda: app.guard.counts()["websocket"] == 1)
        ping = b"\x89\xfd" + bytes(4) + b"p" * 125
        assert peer.flood(ping * 500, 256 << 20) < 256 << 20
        wait_for(lambda: app.guard.counts()["websocket"] == 0)


def test_a_viewer_slower_than_its_feed_stays_and_is_heard():
    pings = {"ws_ping_interval": 0.3, "ws_ping_timeout": 0.5}
    with stub(pings, unread_seconds=2) as app, socket.socket() as raw:
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16 << 10)
        raw.connect(("127.0.0.1", app.port))
        address = f"ws://127.0.0.1:{app.port}/feed"
        with connect(address, sock=raw, compression=None, max_queue=1, ping_interval=None) as viewer:
            began, said = time.monotonic(), 0
            while said < 6:  # one a second, in all six times a ping's interval and its timeout
                viewer.recv()
                viewer.ping()
                if time.monotonic() - began > said:
                    viewer.send(str(said))
                    said += 1
                time.sleep(0.02)
            wait_for(lambda: app.seen == [str(number) for number in range(said)])


def test_of_many_pings_the_newest_is_answered_once_the_peer_reads(app):
    with Peer(app.port, receive_buffer=4096) as peer:
        peer.send(b"GET /feed HTTP/1.1\r\n" + HOST + UPGRADE + b"\r\n")
        assert peer.answer()[0] == 101
        (record,) = app.guard._records.values()
        wait_for(lambda: record.transport.get_write_buffer_size() > 0)  # the peer reads nothing
        peer.send(b"".join(b"\x89\x84" + bytes(4) + b"%04d" % number for number in range(5000)))
        found, limit = b"", time.monotonic() + HANG_S
        while b"\x8a\x044999" not in found and time.monotonic() < limit:
            found += peer.socket.recv(1 << 16)
        assert b"\x8a\x044999" in found
        assert found.count(b"\x8a\x04") < 50


def test_a_peer_that_is_gone_is_found_by_its_pings():
    pings = {"ws_ping_interval": 0.3, "ws_ping_timeout": 0.5}
    with stub(pings) as app, Peer(app.port) as peer:
        peer.send(b"GET /socket HTTP/1.1\r\n" + HOST + UPGRADE + b"\r\n")
        assert peer.answer()[0] == 101
        peer.rest()
