"""Bodies: their progress, their overhead, answers before their end; answers that nobody reads."""

from __future__ import annotations

import json
import socket
import time

import pytest
from peers import GET, HOST, LARGE_MB, SHORT, Peer, drip, put, refused, stub
from waiting import wait_for

from server.connections import guard
from server.connections.connection import GuardedConnection
from server.connections.guard import LINGER_S


def chunk(data, extension=b""):
    return b"%x%s\r\n%s\r\n" % (len(data), extension, data)


def test_a_hanging_upload_is_answered_408(app):
    with Peer(app.port) as peer:
        peer.send(put(b"/echo", 1000), b"abc")
        document = refused(peer.rest(), 408, "body")
        assert "SCAS4D_BODY_SECONDS" in document["remedy"]


@pytest.mark.parametrize("length", [100_000, None])
def test_a_body_that_drips_is_ended(app, length):
    with Peer(app.port) as peer:
        peer.send(put(b"/echo", length))
        drip(peer, b"a" if length else chunk(b"a"))


def test_a_slow_body_that_goes_on_is_taken(app):
    with Peer(app.port) as peer:
        pieces = 12
        peer.send(put(b"/echo", pieces * 20_000))
        for _ in range(pieces):  # in all three times as long as a window
            peer.send(b"a" * 20_000)
            time.sleep(SHORT["body_seconds"] / 4)
        assert json.loads(peer.answer()[2])["length"] == pieces * 20_000


def test_tiny_chunks_are_put_together(app):
    body = bytes(range(256)) * 32
    with Peer(app.port) as peer:
        peer.send(put(b"/echo"), b"".join(chunk(body[at : at + 3]) for at in range(0, len(body), 3)) + b"0\r\n\r\n")
        answer = json.loads(peer.answer()[2])
    assert (answer["length"], answer["sum"]) == (len(body), sum(body))


def test_large_and_small_chunks_are_put_together(app):
    pieces = [bytes([number]) * size for number, size in enumerate((40_000, 1, 100_000, 7, 16_384, 65_536, 3))]
    with Peer(app.port) as peer:
        peer.send(put(b"/echo"), b"".join(map(chunk, pieces)), b"0\r\n\r\n")
        answer = json.loads(peer.answer()[2])
    assert answer["length"] == sum(map(len, pieces))
    assert answer["sum"] == sum(map(sum, pieces))


OVERHEAD = {
    "tiny chunks": (b"", chunk(b"a") * 5000),
    "chunk extensions": (b"5;", b"x=" + b"y" * 5000 + b";"),
    "one long extension": (b"5;x=", b"y" * 65536),
    "trailers": (b"0\r\n", b"X: y\r\n" * 5000),
    "one long trailer": (b"0\r\nX: ", b"y" * 65536),
    "a trailer behind a large body": (chunk(bytes(4 << 20)) + b"0\r\nX: ", b"y" * 65536),
}


@pytest.mark.parametrize("path", [b"/echo", b"/early"])
@pytest.mark.parametrize("name", OVERHEAD)
def test_overhead_without_end_is_ended(app, name, path):
    first, again = OVERHEAD[name]
    with Peer(app.port) as peer:
        peer.send(put(path), first)
        assert peer.flood(again, 64 << 20) < 32 << 20


def test_trailers_are_no_headers(app):
    with Peer(app.port) as peer:
        peer.send(put(b"/late"), b"2\r\nab\r\n0\r\nAuthorization: Bearer x\r\n\r\n")
        assert peer.answer()[0] == 200


def test_small_pieces_grow_without_being_copied():
    class Cycle:
        body = b""
        response_complete = False

    pieces = []
    for first in (b"a", b"a" * 100_000):
        cycle = Cycle()
        connection = GuardedConnection.__new__(GuardedConnection)
        connection.__dict__.update(_fault=None, _delivered=0, _left=None, cycle=cycle)
        connection._record = type("OpenConnection", (), {"body": 0})()
        connection.parser = type("Parser", (), {"should_upgrade": lambda self: False})()
        connection.flow = type("Flow", (), {"pause_reading": lambda self: None})()
        cycle.message_event = type("Event", (), {"set": lambda self: None})()
        connection.on_body(first)
        connection.on_body(b"b")
        grown = cycle.body
        for _ in range(100):
            connection.on_body(b"b")
        assert cycle.body is grown  # a bytearray: bytes would have been joined anew each time
        pieces.append(bytes(grown))
    assert pieces == [b"a" + b"b" * 101, b"a" * 100_000 + b"b" * 101]


def test_the_service_may_take_its_time_before_it_asks_for_the_body(app):
    with Peer(app.port) as peer:
        peer.send(put(b"/late", 5, b"Expect: 100-continue"))
        assert peer.answer()[0] == 100
        peer.send(b"hello")
        assert json.loads(peer.answer()[2])["length"] == 5


@pytest.mark.parametrize("more", [(), (b"Connection: close",), (b"Expect: 100-continue",)])
def test_an_answer_before_the_end_of_the_body_is_read(app, more):
    body = bytes(8 << 20)
    with Peer(app.port) as peer:
        peer.send(put(b"/early", len(body), *more), body)
        assert peer.answer()[0] == 401
        if not more:  # the connection goes on behind the body
            peer.send(GET + b"\r\n")
            assert peer.answer()[0] == 200
    with Peer(app.port) as peer:
        peer.send(put(b"/early", len(body), *more), body[:1000])
        assert peer.answer()[0] == 401
        peer.rest()


def test_a_slow_body_behind_its_answer_is_dropped_to_its_end(app):
    pieces = 14
    with Peer(app.port) as peer:
        peer.send(put(b"/early", pieces * 20_000))
        for _ in range(pieces):  # in all longer than without progress
            peer.send(bytes(20_000))
            time.sleep(LINGER_S / 10)
        assert peer.answer()[0] == 401
        peer.send(GET + b"\r\n")
        assert peer.answer()[0] == 200


def test_a_body_behind_its_answer_does_not_go_on_for_ever(app, monkeypatch):
    monkeypatch.setattr(guard, "LINGER_LONGEST_S", 2.0)
    pieces = 500
    with Peer(app.port) as peer:
        peer.send(put(b"/early", pieces * 20_000))
        for _ in range(pieces):
            if not peer.flood(bytes(20_000), 20_000):
                break
            time.sleep(0.1)
        else:
            pytest.fail("it was taken to its end")


def test_a_body_without_end_behind_its_answer_is_ended(app):
    with Peer(app.port) as peer:
        peer.send(put(b"/early"))
        assert peer.flood(chunk(bytes(65536)), 1 << 30) < 1 << 30


def test_an_answer_that_nobody_reads_is_given_up(app):
    with Peer(app.port, receive_buffer=4096) as peer:
        peer.send(b"GET /large HTTP/1.1\r\n" + HOST + b"\r\n")
        wait_for(lambda: app.guard.counts()["answer"] == 1)
        wait_for(lambda: app.guard.counts()["answer"] == 0)
        peer.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        assert len(peer.rest()) < LARGE_MB << 20


def test_an_answer_that_is_read_slowly_is_sent_to_its_end():
    with stub(unread_seconds=1.5) as app, Peer(app.port, receive_buffer=4096) as peer:
        peer.send(b"GET /large HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n")
        got, began = 0, time.monotonic()
        while time.monotonic() - began < 6:  # four times as long as nobody may read
            got += len(peer.socket.recv(20_000))
            time.sleep(0.02)
        peer.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        assert got + len(peer.rest()) > LARGE_MB << 20


def test_nobody_is_left(app):
    wait_for(lambda: sum(app.guard.counts().values()) == 0)
