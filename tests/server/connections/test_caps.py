"""Caps on connections, and who gives way; clients behind proxies."""

from __future__ import annotations

import json
import resource
from contextlib import ExitStack, suppress

import httpx
import pytest
from peers import GET, HOST, Peer, put, refused, stub
from waiting import HANG_S, wait_for

from server.connections import guard, process_limits
from server.connections.guard import peer_key

LONG = dict(header_seconds=60, body_seconds=60, keep_alive_seconds=60)


def get(app, path="echo", **headers):
    return httpx.get(f"http://127.0.0.1:{app.port}/{path}", headers=headers, timeout=HANG_S)


def held(stack, app, count, *pieces, sources=(None,)):
    peers = [stack.enter_context(Peer(app.port, source=source)) for _ in range(count) for source in sources]
    for peer in peers:
        with suppress(OSError):  # it may have given way
            peer.send(*pieces)
    return peers


@pytest.mark.parametrize("caps", [{"max_connections_per_peer": 8}, {"max_connections": 8}])
@pytest.mark.parametrize("pieces", [(GET,), (), (GET + b"\r\n",)])
def test_half_sent_headers_and_idle_connections_give_way(caps, pieces):
    with stub(**LONG, **caps) as app, ExitStack() as stack:
        peers = held(stack, app, 30, *pieces)
        for _ in range(20):
            assert get(app).status_code == 200
        wait_for(lambda: sum(app.guard.counts().values()) <= 8)
        peers[0].rest()  # the oldest was closed


def test_uploads_give_way_once_they_are_quiet(monkeypatch):
    monkeypatch.setattr(guard, "QUIET_S", 3600)
    with stub(**LONG, max_connections_per_peer=8) as app, ExitStack() as stack:
        held(stack, app, 8, put(b"/echo", 100_000), bytes(20_000))
        wait_for(lambda: app.guard.counts()["body"] == 8)
        assert get(app).status_code == 429  # they may be at work
        monkeypatch.setattr(guard, "QUIET_S", 0)
        wait_for(lambda: get(app).status_code == 200)


@pytest.mark.parametrize("caps", [{"max_connections_per_peer": 16}, {"max_connections": 16}])
def test_uploads_that_hang_from_the_start_take_half_of_the_places(caps):
    with stub(**LONG, **caps) as app, ExitStack() as stack:
        sending = held(stack, app, 1, put(b"/echo", 100_000), bytes(20_000))[0]
        wait_for(lambda: app.guard.counts()["body"] == 1)
        for _ in range(4):
            held(stack, app, 20, put(b"/echo", 1000), b"abc")
            sending.send(bytes(1000))  # on a busy machine the rounds take so long that it would be quiet
            assert get(app).status_code == 200
        assert app.guard.counts()["body"] <= 8
        sending.send(bytes(76_000))
        assert sending.answer()[0] == 200


OTHERS = [f"127.0.0.{2 + number}" for number in range(24)]


@pytest.mark.parametrize("pieces", [(), (GET,), (put(b"/echo", 1000), b"abc")])
def test_who_has_many_addresses_neither_keeps_a_rig_out_nor_ends_its_connections(pieces):
    with stub(**LONG, max_connections=24) as app, ExitStack() as stack:
        idle = held(stack, app, 3, GET + b"\r\n")
        for peer in idle:
            assert peer.answer()[0] == 200
        uploads = held(stack, app, 3, put(b"/echo", 100_000), bytes(20_000))
        wait_for(lambda: app.guard.counts()["body"] == 3)
        for _ in range(3):
            held(stack, app, 1, *pieces, sources=OTHERS)
            for peer in uploads:
                peer.send(bytes(1000))
            assert get(app).status_code == 200
        with Peer(app.port, source="127.0.0.99") as newcomer:
            newcomer.send(GET + b"\r\n")
            assert newcomer.answer()[0] == 200
        for peer in uploads:
            peer.send(bytes(77_000))
            assert peer.answer()[0] == 200
        for peer in idle:
            peer.send(GET + b"\r\n")
            assert peer.answer()[0] == 200


def test_uploads_that_are_quiet_give_way_whoever_has_most_connections(monkeypatch):
    monkeypatch.setattr(guard, "QUIET_S", 3600)
    with stub(**LONG, max_connections=8) as app, ExitStack() as stack:
        rig = held(stack, app, 5, b"GET /wait HTTP/1.1\r\n" + HOST + b"\r\n")
        held(stack, app, 1, put(b"/echo", 100_000), bytes(20_000), sources=OTHERS[:3])
        wait_for(lambda: app.guard.counts()["body"] == 3)
        assert get(app).status_code == 503
        monkeypatch.setattr(guard, "QUIET_S", 0)
        wait_for(lambda: get(app).status_code == 200)
        app.go.set()
        for peer in rig:
            assert peer.answer()[0] == 200


def test_a_network_of_ipv6_is_one_peer():
    assert peer_key("2001:db8:1:2::3") == peer_key("2001:db8:1:2:ffff::4") == "2001:db8:1:2::/64"
    assert peer_key("2001:db8:1:3::3") != peer_key("2001:db8:1:2::3")
    assert peer_key("::ffff:192.0.2.1") == peer_key("192.0.2.1") == "192.0.2.1"
    assert peer_key("") == ""


@pytest.mark.parametrize("caps", [{"max_connections_per_peer": 16}, {"max_connections": 16}])
def test_a_slow_upload_that_goes_on_stays_where_others_hang(caps, monkeypatch):
    monkeypatch.setattr(guard, "QUIET_S", HANG_S)
    with stub(**LONG, **caps) as app, ExitStack() as stack:
        slow = held(stack, app, 1, put(b"/echo", 40_000), bytes(20_000))[0]
        wait_for(lambda: app.guard.counts()["body"] == 1)
        wait_for(lambda: not any(record.received for record in app.guard._records.values()))  # a window has ended
        for _ in range(3):
            slow.send(bytes(1000))
            held(stack, app, 20, put(b"/echo", 1000), b"abc")
            assert get(app).status_code == 200
        slow.send(bytes(17_000))
        assert slow.answer()[0] == 200


@pytest.mark.parametrize(("caps", "status"), [({"max_connections_per_peer": 8}, 429), ({"max_connections": 8}, 503)])
def test_connections_at_work_stay_and_a_further_one_is_told_so(caps, status):
    with stub(**LONG, **caps) as app, ExitStack() as stack:
        peers = held(stack, app, 8, b"GET /wait HTTP/1.1\r\n" + HOST + b"\r\n")
        wait_for(lambda: app.guard.counts()["answer"] == 8)
        for _ in range(100):
            with Peer(app.port) as peer:
                peer.send(GET + b"\r\n")
                refused(peer.rest(), status, "client")
        app.go.set()
        for peer in peers:
            assert peer.answer()[0] == 200
        assert get(app).status_code == 200


def test_a_connection_that_was_answered_stays_before_one_that_never_asked():
    with stub(**LONG, max_connections_per_peer=8) as app, ExitStack() as stack:
        known = held(stack, app, 1, GET + b"\r\n")[0]
        assert known.answer()[0] == 200
        held(stack, app, 30, GET)
        known.send(GET + b"\r\n")
        assert known.answer()[0] == 200


def test_what_others_say_about_themselves_is_not_believed():
    with stub() as app:
        answer = get(app, **{"X-Forwarded-For": "203.0.113.7", "X-Forwarded-Proto": "https"})
        assert answer.json()["client"] == "127.0.0.1"


def test_a_trusted_proxy_is_believed_and_its_clients_are_counted():
    with stub(**LONG, max_connections_per_peer=4, trusted_proxies="127.0.0.0/8") as app, ExitStack() as stack:
        waiting = b"GET /wait HTTP/1.1\r\n" + HOST + b"X-Forwarded-For: 203.0.113.7\r\n\r\n"
        peers = held(stack, app, 4, waiting)
        wait_for(lambda: app.guard.counts()["answer"] == 4)
        answer = get(app, **{"X-Forwarded-For": "10.9.9.9, 203.0.113.7"})  # the last is what the proxy added
        assert answer.status_code == 429
        assert answer.json()["field"] == "client"
        assert answer.headers["retry-after"]
        for number in range(8):  # other clients, and the proxy itself
            name = {} if number == 7 else {"X-Forwarded-For": f"203.0.113.{10 + number}"}
            assert get(app, **name).json()["client"] == name.get("X-Forwarded-For", "127.0.0.1")
        app.go.set()
        for peer in peers:
            assert peer.answer()[0] == 200
        assert get(app, **{"X-Forwarded-For": "203.0.113.7"}).status_code == 200


def test_uploads_of_one_peer_do_not_keep_out_another_request():
    with stub(max_connections_per_peer=8) as app, ExitStack() as stack:
        held(stack, app, 4, put(b"/echo", 1000), b"abc")
        held(stack, app, 30, GET)
        assert json.loads(get(app).content)["path"] == "/echo"


def test_there_is_a_file_for_every_connection():
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        assert process_limits.raise_open_file_limit(10) == 10
        assert 10 < process_limits.raise_open_file_limit(1 << 40) < 1 << 40
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
