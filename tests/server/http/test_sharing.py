"""Tokens that may only read, and links to share: what they open, and what they do not."""

from __future__ import annotations

import asyncio
import re

import httpx
import pytest
import websockets
from running import Running, fake_settings, make_rig, pictures, problem
from waiting import HANG_S

from client.sdk import Client
from client.wire.stream import STREAM_PROTOCOL
from server.http import sharing
from server.http.sharing import Sharing

TOKEN = "a-token-that-is-long-enough"


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    service = Running(fake_settings(tmp_path_factory.mktemp("sharing"), token=TOKEN))
    yield service
    service.stop()


@pytest.fixture(scope="module")
def scenes(running):
    """Two scenes with a committed frame each."""
    with Client(running.url, token=TOKEN) as sdk:
        ids = [sdk.create_scene(make_rig(), name=name).id for name in ("shown", "hidden")]
        for id in ids:
            sdk.put_frame(id, 0, pictures())
            sdk.wait(id, 0)
        return ids


def bearer(running, token):
    return httpx.Client(base_url=running.url, headers={"Authorization": f"Bearer {token}"}, timeout=HANG_S)


@pytest.fixture(scope="module")
def owner(running):
    with Client(running.url, token=TOKEN) as sdk:
        yield sdk


READS = (
    "",
    "/rig",
    "/frames",
    "/frames/0",
    "/frames/0/cameras/c0",
    "/render",
    "/budget",
    "/tradeoff",
    "/parts",
    "/exports",
)
CHANGES = (
    ("PATCH", ""),
    ("DELETE", ""),
    ("POST", "/pause"),
    ("POST", "/resume"),
    ("POST", "/sleep"),
    ("PUT", "/points"),
    ("PUT", "/frames/1"),
    ("PUT", "/frames/1/cameras/c0"),
    ("POST", "/frames/1/close"),
    ("POST", "/frames/1/missing"),
    ("PUT", "/budget"),
    ("POST", "/tradeoff"),
    ("DELETE", "/tradeoff"),
    ("PUT", "/reconstructions/1"),
    ("POST", "/exports"),
    ("DELETE", "/exports/x"),
)


@pytest.mark.parametrize("of_all", [False, True])
def test_it_reads_and_changes_nothing(running, owner, scenes, of_all):
    shown, _ = scenes
    token = owner.share(None if of_all else shown).token
    with bearer(running, token) as http:
        for path in READS:
            assert http.get(f"/v1/scenes/{shown}{path}").status_code == 200, path
        assert http.post(f"/v1/scenes/{shown}/render", json={"camera": "c0"}).status_code == 200
        for method, path in CHANGES:
            document = problem(http.request(method, f"/v1/scenes/{shown}{path}"), 403)
            assert document["field"] == "Authorization"
        for method, path in (("POST", "/v1/scenes"), ("POST", "/v1/shares")):
            problem(http.request(method, path, json={}), 403 if of_all or path == "/v1/scenes" else 404)
    assert owner.scene(shown).committed == 1
    assert not owner.scene(shown).paused


def test_every_route_that_changes_something_is_refused(running, owner, scenes):
    """A route that is new is refused until somebody says that it reads."""
    token = owner.share().token
    reads = {"/v1/tickets", "/v1/estimate", "/v1/scenes/{id}/render", "/v1/scenes/{id}/tracks/query"}
    with bearer(running, token) as http:
        for path, operations in http.get("/openapi.json").json()["paths"].items():
            for method in set(operations) - {"get", "head"}:
                if path not in reads:
                    problem(http.request(method, re.sub(r"{\w+}", "0", path)), 403)


def test_a_link_shows_one_scene(running, owner, scenes):
    shown, hidden = scenes
    with bearer(running, owner.share(shown).token) as http:
        assert [scene["id"] for scene in http.get("/v1/scenes").json()["scenes"]] == [shown]
        for path in (f"/v1/scenes/{hidden}", f"/v1/scenes/{hidden}/render", "/v1/scenes/nowhere", "/metrics"):
            problem(http.get(path), 404)
        for path in (f"/v1/scenes/{shown}/../{hidden}", f"/v1/scenes/{shown}%2F..%2F{hidden}", f"/v1/scenes/{shown}x"):
            raw = httpx.Request("GET", httpx.URL(running.url).copy_with(raw_path=path.encode()), headers=http.headers)
            problem(http.send(raw), 404)
    with bearer(running, owner.share().token) as http:
        assert len(http.get("/v1/scenes").json()["scenes"]) == 2
        assert http.get("/metrics").status_code == 200


def opened(running, address, token, protocols):
    """The status of a handshake: 101, or that of its refusal."""

    async def run():
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        url = running.url.replace("http", "ws") + address
        try:
            async with websockets.connect(url, subprotocols=protocols, additional_headers=headers):
                return 101
        except websockets.InvalidStatus as error:
            return error.response.status_code

    return asyncio.run(run())


def test_websockets(running, owner, scenes):
    shown, hidden = scenes
    token = owner.share(shown).token
    assert opened(running, f"/v1/scenes/{shown}/stream", token, [STREAM_PROTOCOL]) == 101
    assert opened(running, f"/v1/scenes/{hidden}/stream", token, [STREAM_PROTOCOL]) == 404
    for address in ("ingest", "ingest%0A", "ingest%0D", "ingest/", "%69ngest", "stream%0A"):
        assert opened(running, f"/v1/scenes/{shown}/{address}", token, None) in (400, 403), address
    with bearer(running, token) as http:  # a ticket opens what the token does that it was asked with
        for address, status in ((f"{shown}/stream", 101), (f"{hidden}/stream", 404), (f"{shown}/ingest", 403)):
            ticket = http.post("/v1/tickets").json()["subprotocol"]
            assert opened(running, f"/v1/scenes/{address}", None, [STREAM_PROTOCOL, ticket]) == status


def test_it_ends(running, owner, scenes, monkeypatch):
    token = owner.share(scenes[0], seconds=60).token
    with bearer(running, token) as http:
        assert http.get("/v1/scenes").status_code == 200
        now = sharing.time.time()
        monkeypatch.setattr(sharing.time, "time", lambda: now + 61)
        assert "has expired" in problem(http.get("/v1/scenes"), 401)["detail"]


def test_a_stream_ends_with_its_link(running, owner, scenes):
    async def run(seconds):
        address = f"{running.url.replace('http', 'ws')}/v1/scenes/{scenes[0]}/stream"
        headers = {"Authorization": f"Bearer {owner.share(scenes[0], seconds=seconds).token}"}
        async with websockets.connect(address, subprotocols=[STREAM_PROTOCOL], additional_headers=headers) as socket:
            while True:
                try:
                    await asyncio.wait_for(socket.recv(), 3)
                except TimeoutError:
                    return None
                except websockets.ConnectionClosed as closed:
                    return closed.rcvd.code, closed.rcvd.reason

    assert asyncio.run(run(2)) == (1008, "the link has expired")
    assert asyncio.run(run(60)) is None


def test_a_token_that_was_changed_opens_nothing(running, owner, scenes):
    shown, hidden = scenes
    token = owner.share(shown).token
    text, _, signature = token.rpartition(".")
    others = (
        f"{text}.{'A' if signature[0] != 'A' else 'B'}{signature[1:]}",
        token.replace(shown, hidden),
        token.replace(shown, "*"),
        re.sub(r"\.(\d+)\.", lambda found: f".{int(found[1]) + 1}.", token),
        token.rpartition(".")[0],
        "scas4d.read...",
        "scas4d.read.*.99999999999.",
        Sharing("another-token-of-another-service").issue(shown, 99_999_999_999),
    )
    for other in others:
        with bearer(running, other) as http:
            assert "invalid" in problem(http.get(f"/v1/scenes/{shown}"), 401)["detail"]


def test_what_cannot_be_shared(running, owner, tmp_path):
    with bearer(running, TOKEN) as http:
        problem(http.post("/v1/shares", json={"scene": "nowhere"}), 404)
        assert problem(http.post("/v1/shares", json={"seconds": 0}), 422)["field"] == "body.seconds"
    open_service = Running(fake_settings(tmp_path))
    try:
        assert (
            problem(httpx.post(f"{open_service.url}/v1/shares", json={}, timeout=HANG_S), 409)["field"]
            == "SCAS4D_TOKEN"
        )
    finally:
        open_service.stop()
