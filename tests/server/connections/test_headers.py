"""Headers: how large, how many lines, how long they may take; what is behind them."""

from __future__ import annotations

import json
import time

import pytest
from peers import GET, HOST, SHORT, Peer, drip, parsed, refused
from waiting import wait_for

LIMIT = SHORT["header_kb"] << 10


def line(size):
    return b"X: " + b"a" * (size - 5) + b"\r\n"


def test_a_header_of_exactly_the_limit_is_taken(app):
    with Peer(app.port) as peer:
        peer.send(GET, line(LIMIT - len(GET) - 3), b"\r\n")
        assert peer.answer()[0] == 200


@pytest.mark.parametrize("pieces", [1, 50])
def test_a_larger_header_is_refused(app, pieces):
    seen = len(app.seen)
    with Peer(app.port) as peer:
        whole = GET + line(LIMIT)
        step = -(-len(whole) // pieces)
        for at in range(0, len(whole), step):
            peer.send(whole[at : at + step])
            time.sleep(0.1 / pieces)
        refused(peer.rest(), 431, "headers")
    assert len(app.seen) == seen


def test_an_endless_header_is_not_read_to_its_end(app):
    with Peer(app.port) as peer:
        peer.send(GET + b"X: ")
        assert peer.flood(b"a" * 65536, 64 << 20) < 32 << 20


def test_so_many_lines_and_no_more(app):
    for more, status in ((99, 200), (100, 431)):
        with Peer(app.port) as peer:
            peer.send(GET, b"a: b\r\n" * more, b"\r\n")
            answer = peer.answer()[0] if status == 200 else refused(peer.rest(), 431, "headers")["status"]
            assert answer == status


@pytest.mark.parametrize("whole", [True, False])
def test_a_long_address_is_refused(app, whole):
    with Peer(app.port) as peer:
        peer.send(b"GET /" + b"a" * LIMIT + (b" HTTP/1.1\r\n" + HOST + b"\r\n" if whole else b""))
        refused(peer.rest(), 414, "path")


def test_a_half_sent_header_is_answered_in_time(app):
    with Peer(app.port) as peer:
        peer.send(GET + b"X: a")
        document = refused(peer.rest(), 408, "headers")
        assert "SCAS4D_HEADER_SECONDS" in document["remedy"]


def test_a_silent_connection_is_closed_without_a_word(app):
    with Peer(app.port) as peer:
        assert peer.rest() == b""


def test_a_header_that_drips_is_ended(app):
    with Peer(app.port) as peer:
        peer.send(GET + b"X: ")
        drip(peer, b"a")


def test_blank_lines_between_requests_do_not_hold_a_connection(app):
    with Peer(app.port) as peer:
        peer.send(GET + b"\r\n")
        assert peer.answer()[0] == 200
        drip(peer, b"\r\n")


def test_a_connection_is_kept_alive_and_then_closed(app):
    with Peer(app.port) as peer:
        for _ in range(3):
            peer.send(GET + b"\r\n")
            assert peer.answer()[0] == 200
            time.sleep(0.3 * SHORT["keep_alive_seconds"])
        assert peer.rest() == b""


BAD = {
    "both lengths": b"PUT /echo HTTP/1.1\r\n"
    + HOST
    + b"Content-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    "two lengths": b"PUT /echo HTTP/1.1\r\n" + HOST + b"Content-Length: 3\r\nContent-Length: 4\r\n\r\nabc",
    "negative length": b"PUT /echo HTTP/1.1\r\n" + HOST + b"Content-Length: -1\r\n\r\n",
    "no last coding": b"PUT /echo HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: gzip\r\n\r\nabc",
    "huge chunk": b"PUT /echo HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n" + b"f" * 17 + b"\r\n",
    "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(40),
    "a tunnel": b"CONNECT example.org:443 HTTP/1.1\r\n" + HOST + b"\r\n",
    "no UTF-8": b"GET /\xff HTTP/1.1\r\n" + HOST + b"\r\n",
    "a folded line": b"GET /echo HTTP/1.1\r\n" + HOST + b" folded\r\n\r\n",
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_http_is_answered_400_and_ends(app, name, caplog):
    with Peer(app.port) as peer:
        peer.send(BAD[name])
        answer = peer.rest()
    if name == "a folded line" and parsed(answer)[0] == 200:
        pytest.skip("the parser takes folded lines")
    assert parsed(answer)[0] in (400, 404, 405)
    assert answer.count(b"HTTP/1.1 ") == 1
    assert not [record for record in caplog.records if "Invalid HTTP" in record.message]


def test_what_follows_an_unknown_protocol_is_no_request(app):
    seen = len(app.seen)
    with Peer(app.port) as peer:
        upgrade = b"Connection: Upgrade\r\nUpgrade: h2c\r\nContent-Length: 30\r\n\r\n"
        peer.send(b"PUT /echo HTTP/1.1\r\n" + HOST + upgrade + GET + b"\r\n" + b"GET /echo HTTP/1.1\r\n\r\n" * 100)
        answer = peer.rest()
    assert answer.count(b"HTTP/1.1 ") == 1
    assert len(app.seen) - seen <= 1


def test_pipelined_requests_are_answered_in_order(app):
    with Peer(app.port) as peer:
        body = b"x" * 300_000
        put = b"PUT /echo?a HTTP/1.1\r\n" + HOST + b"Content-Length: 300000\r\n\r\n"
        peer.send(put + body + GET + b"\r\n" + put + body + GET + b"\r\n")
        lengths = [json.loads(peer.answer()[2])["length"] for _ in range(4)]
    assert lengths == [300_000, 0, 300_000, 0]


def test_a_request_behind_a_chunked_body_is_answered(app):
    with Peer(app.port) as peer:
        put = b"PUT /echo HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\n"
        peer.send(put + b"5\r\nhello\r\n0\r\nX-Trailer: y\r\n\r\n" + GET + line(2000) + b"\r\n")
        assert [json.loads(peer.answer()[2])["length"] for _ in range(2)] == [5, 0]


def test_thousands_of_pipelined_requests_do_not_pile_up(app):
    seen = len(app.seen)
    with Peer(app.port) as peer:
        peer.send((GET + b"\r\n") * 4000)
        answers = peer.rest()
    assert 16 <= answers.count(b"HTTP/1.1 200") <= 40
    assert b"connection: close" in answers[answers.rindex(b"HTTP/1.1 200") :]
    assert len(app.seen) - seen <= 40


def test_nobody_is_left(app):
    wait_for(lambda: sum(app.guard.counts().values()) == 0)
