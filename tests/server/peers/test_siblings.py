"""Services of one cluster: whichever a client asks, it gets the answer of the one that has the scene."""

from __future__ import annotations

import asyncio
import contextlib
import http.server
import json
import socket
import threading
import time
import types

import httpx
import numpy as np
import pytest
from running import Running, fake_settings, picture, pictures, problem
from sending import FRAMED, create, framed, put_form, put_framed, wait_for
from waiting import HANG_S
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from client.sdk import Client
from client.wire.stream import STREAM_PROTOCOL
from server.http.permissions import ALL, PERMISSION, Permission
from server.peers import peers as module
from server.peers.peers import Peers
from server.peers.proxy import ProxyMiddleware
from server.processes.placement import Placement

TOKEN = "the token of all services 0123456789".replace(" ", "-")
NOBODYS = "0123456789ab"
HEADERS = {"Authorization": f"Bearer {TOKEN}"}


RUNNING, GONE = [], []
"""Services that run, and addresses at which none does."""


class Together(Placement):
    """Placement of services that know one another by a list."""

    has_peers = True

    async def peers(self):
        return [one.url for one in RUNNING if one.app.state.placement is not self] + GONE


@pytest.fixture(scope="module", params=[None, TOKEN], ids=["open", "token"])
def services(request, tmp_path_factory):
    """Three services; each has scenes of its own."""
    made = []
    for name in "abc":
        settings = fake_settings(tmp_path_factory.mktemp(name), queue_frames=20, token=request.param, max_body_mb=0.2)
        made.append(Running(settings, placement=Together))
    RUNNING[:] = made
    headers = HEADERS if request.param else {}
    clients = [httpx.Client(base_url=one.url, timeout=HANG_S, headers=headers) for one in made]
    yield clients, request.param
    for client in clients:
        client.close()
    for one in made:
        one.stop()


@pytest.fixture
def fresh(monkeypatch):
    """What was found is asked for again at once."""
    monkeypatch.setattr(module, "FRESH_S", 0.0)


@pytest.fixture
def other(services):
    """A service, and a scene of another one that has two frames."""
    (first, second, _), _ = services
    id = create(first, queue_frames=20)
    for index in range(2):
        assert put_framed(second, id, index, pictures(index)).status_code == 202
    wait_for(lambda: second.get(f"/v1/scenes/{id}").json()["committed"] == 2)
    yield second, id
    second.delete(f"/v1/scenes/{id}")


def test_frames_views_tracks_and_parts_of_a_scene_elsewhere(services, other):
    (first, *_), _ = services
    second, id = other
    for path, asked in (
        ("render", {"camera": "c0", "frame": 1}),
        ("tracks/query", {"ids": [0, 1]}),
        ("parts", None),
        ("frames/1", None),
        ("gaussians.ply", None),
    ):
        answers = [
            http.get(f"/v1/scenes/{id}/{path}") if asked is None else http.post(f"/v1/scenes/{id}/{path}", json=asked)
            for http in (first, second)
        ]
        assert [answer.status_code for answer in answers] == [answers[0].status_code] * 2
        assert answers[0].content == answers[1].content
        names = {"content-type", "x-frame", "cache-control", "etag"}
        shown = [{name: answer.headers.get(name) for name in names} for answer in answers]
        assert shown[0] == shown[1]


def test_every_way_to_send_frames(services, other):
    second, id = other
    assert put_form(second, id, 2, pictures(2)).status_code == 202
    for camera in ("c0", "c1"):
        sent = second.put(f"/v1/scenes/{id}/frames/3/cameras/{camera}", content=picture(3))
        assert sent.status_code in (200, 202), sent.text
    chunks = (part for part in [framed(4)[:50], framed(4)[50:]])  # without a length
    assert second.put(f"/v1/scenes/{id}/frames/4", content=chunks, headers=FRAMED).status_code == 202
    wait_for(lambda: second.get(f"/v1/scenes/{id}").json()["committed"] == 5)


def test_refusals_are_those_of_the_service_that_has_the_scene(services, other):
    second, id = other
    assert problem(put_framed(second, id, 9, pictures(9)), 409)["expected"] == 2
    assert problem(second.get(f"/v1/scenes/{id}/frames/0?nonsense=1"), 422)["field"] == "nonsense"
    assert problem(second.put(f"/v1/scenes/{id}/frames/2", content=b"x" * 300_000, headers=FRAMED), 413)
    assert second.head(f"/v1/scenes/{id}").status_code == 200
    assert second.head(f"/v1/scenes/{id}").content == b""


def test_scenes_that_nobody_has_are_not_found(services):
    (first, *_), _ = services
    assert problem(first.get(f"/v1/scenes/{NOBODYS}"), 404)
    assert problem(first.put(f"/v1/scenes/{NOBODYS}/frames/0", content=framed(0), headers=FRAMED), 404)


def test_all_scenes_are_listed_by_every_service(services, other):
    (first, second, third), _ = services
    _, id = other
    mine = create(third)
    lists = [[one["id"] for one in http.get("/v1/scenes").json()["scenes"]] for http in (first, second, third)]
    assert lists[0] == lists[1] == lists[2]
    assert {id, mine} <= set(lists[0])
    assert "x-unreachable" not in first.get("/v1/scenes").headers
    assert first.delete(f"/v1/scenes/{mine}").status_code == 204
    assert problem(third.get(f"/v1/scenes/{mine}"), 404)


def test_the_cluster_is_told_with_the_scenes_of_every_service(services, other):
    (first, second, third), _ = services
    _, id = other
    told = [client.get("/v1/cluster").json() for client in (first, second, third)]
    assert all(id in found["nodes"][0]["scenes"] for found in told)
    assert len({json.dumps(found["nodes"]) for found in told}) == 1
    own = [
        client.get("/v1/cluster", headers={module.PROXIED_HEADER: "1"}).json()["nodes"][0] for client in (first, second)
    ]
    assert id in own[0]["scenes"]
    assert id not in own[1]["scenes"]
    assert told[1]["nodes"][0]["cpus_reserved"] >= own[0]["cpus_reserved"] + own[1]["cpus_reserved"] >= 1
    GONE.append("http://127.0.0.1:9")
    try:
        wait_for(lambda: "x-unreachable" in second.get("/v1/cluster").headers)
    finally:
        GONE.clear()


def test_streams_and_ingest_by_websocket(services, other):
    second, id = other
    (first, *_), token = services
    url = str(second.base_url).replace("http", "ws").rstrip("/")
    headers = HEADERS if token else {}
    with connect(f"{url}/v1/scenes/{id}/ingest", additional_headers=headers) as socket:
        socket.send(framed(2, pictures(2)))
        assert '"status":202' in socket.recv().replace(" ", "")
    with Client(str(second.base_url).rstrip("/"), token=token, busy_timeout=HANG_S) as sdk:
        sdk.wait(id, 2)
        image = sdk.render(id, "c0", 2)
    assert image.shape[2] == 3
    offered = [STREAM_PROTOCOL]
    if token:  # as a browser does behind a load balancer
        ticket = first.post("/v1/tickets").json()["ticket"]
        offered.append(f"scas4d.ticket.{ticket}")
    with connect(f"{url}/v1/scenes/{id}/stream", subprotocols=offered) as socket:
        assert socket.subprotocol == STREAM_PROTOCOL
        socket.send(json.dumps({"type": "subscribe", "id": "f", "topic": "frames"}))
        assert [json.loads(socket.recv(timeout=HANG_S))["type"] for _ in range(2)] == ["hello", "subscribed"]
        asked = {"camera": "c0", "kinds": ["colour"], "format": "png"}
        socket.send(json.dumps({"type": "subscribe", "id": "v", "topic": "render", "request": asked}))
        assert put_framed(second, id, 3, pictures(3)).status_code == 202
        found = []
        wait_for(lambda: found.append(socket.recv(timeout=HANG_S)) or any('"committed"' in str(one) for one in found))
        wait_for(lambda: found.append(socket.recv(timeout=HANG_S)) or any(isinstance(one, bytes) for one in found))
        second.delete(f"/v1/scenes/{id}")
        with contextlib.suppress(ConnectionClosed):
            for _ in range(50):
                socket.recv(timeout=HANG_S)
        assert socket.close_code == 4404, (socket.close_code, socket.close_reason)


def test_handshakes_are_refused_with_the_others_words(services, other):
    second, id = other
    _, token = services
    url = str(second.base_url).replace("http", "ws").rstrip("/")
    with pytest.raises(Exception, match="400") as refused:
        connect(f"{url}/v1/scenes/{id}/stream", additional_headers=HEADERS if token else {})
    assert "offers no supported subprotocol" in refused.value.response.body.decode()


def test_who_may_only_read_one_scene_may_no_more_elsewhere(services, other):
    second, id = other
    _, token = services
    if not token:
        pytest.skip("there is no token")
    share = second.post("/v1/shares", json={"scene": id, "seconds": 600})
    assert share.status_code in (200, 201), share.text
    link = {"Authorization": f"Bearer {share.json()['token']}"}
    assert second.get(f"/v1/scenes/{id}", headers=link).status_code == 200
    assert problem(second.delete(f"/v1/scenes/{id}", headers=link), 403)
    assert [one["id"] for one in second.get("/v1/scenes", headers=link).json()["scenes"]] == [id]
    assert problem(second.get(f"/v1/scenes/{id}", headers={"Authorization": "Bearer wrong"}), 401)
    assert problem(second.get(f"/v1/scenes/{id}", headers={"X-Scas4d-Proxied": "1"}), 404)


def test_a_service_that_does_not_answer_is_no_scene_that_is_not_there(services, other, fresh):
    """Its clients send again, rather than give up."""
    second, id = other
    GONE.append("http://127.0.0.1:9")
    try:
        answer = second.get(f"/v1/scenes/{NOBODYS}")
        assert problem(answer, 503)["remedy"].startswith("try again")
        assert answer.headers["retry-after"]
        assert second.get("/v1/scenes").headers["x-unreachable"] == "http://127.0.0.1:9"
        assert second.get(f"/v1/scenes/{id}").status_code == 200
    finally:
        GONE.clear()


def asked(handler, secret=None):
    """A service with one peer, which is a function."""

    async def listed():
        return ["http://other"]

    client = httpx.AsyncClient(transport=httpx.MockTransport(handler))
    return Peers(listed, secret, client)


def test_ids_that_nobody_has_are_asked_for_once_in_a_while(monkeypatch):
    calls = []

    def handler(request):
        calls.append(request.url.path)
        return httpx.Response(404)

    async def test():
        peers = asked(handler)
        assert [await peers.owner("x") for _ in range(5)] == [None] * 5
        assert len(calls) == 1
        monkeypatch.setattr(module, "MOST_UNKNOWN", 2)
        for name in ("a", "b", "c"):
            await peers.owner(name)
        await peers.owner("x")
        assert len(calls) == 5

    asyncio.run(test())


@pytest.mark.parametrize("status", [307, 401, 403, 421, 422, 429, 500, 503])
def test_one_that_does_not_say_may_have_it(status):
    async def test():
        with pytest.raises(module.Problem) as refused:
            await asked(lambda request: httpx.Response(status)).owner("x")
        assert refused.value.document.status == 503

    asyncio.run(test())


def test_one_that_was_known_and_is_gone_is_waited_for(monkeypatch):
    monkeypatch.setattr(module, "FRESH_S", 0.0)
    there = ["http://other"]

    async def listed():
        return there

    async def test():
        client = httpx.AsyncClient(transport=httpx.MockTransport(lambda request: httpx.Response(200)))
        peers = Peers(listed, None, client)
        assert await peers.owner("x") == "http://other"
        there.clear()
        with pytest.raises(module.Problem):
            await peers.owner("x")
        monkeypatch.setattr(module, "REMEMBERED_S", 0.0)
        assert await peers.owner("x") is None

    asyncio.run(test())


def test_it_is_seen_among_the_siblings_that_counts_not_when_its_scene_was_asked_for(monkeypatch):
    monkeypatch.setattr(module, "FRESH_S", 0.0)
    there, now = ["http://other"], [0.0]
    monkeypatch.setattr(module, "time", types.SimpleNamespace(monotonic=lambda: now[0], time=time.time))

    async def listed():
        return list(there)

    async def test():
        client = httpx.AsyncClient(transport=httpx.MockTransport(lambda request: httpx.Response(200)))
        peers = Peers(listed, None, client)
        assert await peers.owner("x") == "http://other"
        now[0] = 700.0
        assert await peers.owner("y") == "http://other"
        await asyncio.sleep(0.01)
        there.clear()
        now[0] = 701.0
        with pytest.raises(module.Problem):
            await peers.owner("x")

    asyncio.run(test())


@pytest.mark.parametrize("fails", [True, False])
def test_before_anybody_is_known_no_scene_is_known_not_to_be_there(monkeypatch, *, fails):
    """A rig that sends at the service's start would be told that its scene is gone."""
    monkeypatch.setattr(module, "LIST_S", 0.05)

    async def listed():
        if fails:
            raise RuntimeError("the head does not answer")
        await asyncio.Event().wait()

    async def test():
        peers = Peers(listed, None)
        for _ in range(2):
            with pytest.raises(module.Problem) as refused:
                await peers.owner("x")
            assert refused.value.document.status == 503
        await peers.close()

    asyncio.run(test())


def test_one_that_does_not_tell_its_address_may_have_the_scene():
    async def listed():
        return ["service.a1b2c3"]

    async def test():
        peers = Peers(listed, None)
        with pytest.raises(module.Problem):
            await peers.owner("x")
        assert await peers.scenes(ALL) == ([], ["service.a1b2c3"])
        await peers.close()

    asyncio.run(test())


class Nothing(httpx.AsyncByteStream):
    """The body of an answer that has none, read as it comes."""

    async def __aiter__(self):
        yield b""


async def passed_on(peers, method, path, *headers):
    """What the service sends that passes a request on; the client waits, and sends no more."""
    sent = []

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "method": method, "path": path, "headers": list(headers), PERMISSION: ALL}
    await ProxyMiddleware(None, lambda: peers, lambda scene: False, 1000)(scope, lambda: asyncio.Event().wait(), send)
    return sent


def test_nothing_is_left_of_a_request_whose_sibling_goes():
    """One task stayed for each frame that a rig sent meanwhile."""

    class Gone(httpx.AsyncBaseTransport):
        async def handle_async_request(self, request):
            if request.method == "PUT":
                raise httpx.ConnectError("gone")
            return httpx.Response(200)

    async def listed():
        return ["http://other"]

    async def test():
        peers = Peers(listed, None, httpx.AsyncClient(transport=Gone()))
        sent = await passed_on(peers, "PUT", f"/v1/scenes/{NOBODYS}/frames/0", (b"content-length", b"5"))
        assert sent[0]["status"] == 503
        assert asyncio.all_tasks() == {asyncio.current_task()}

    asyncio.run(test())


def test_an_owner_that_has_a_scene_no_more_is_forgotten():
    """Its folder may be served at another address by now; a rig asks for nothing but its frames."""
    answers = iter([200, 404, 404])

    async def test():
        peers = asked(lambda request: httpx.Response(next(answers), stream=Nothing()))
        await passed_on(peers, "GET", f"/v1/scenes/{NOBODYS}/frames/0")
        assert NOBODYS not in peers._owners

    asyncio.run(test())


def test_a_frame_that_has_not_come_is_no_scene_that_is_gone():
    """Else a viewer that asks for it makes each request of the rig ask all services again."""
    calls = []

    def handler(request):
        calls.append(request.url.path)
        return httpx.Response(404 if "frames" in request.url.path else 200, stream=Nothing())

    async def test():
        peers = asked(handler)
        path = f"/v1/scenes/{NOBODYS}/frames/7"
        for _ in range(4):
            await passed_on(peers, "GET", path)
        assert peers._owners == {NOBODYS: "http://other"}
        assert [found for found in calls if found != path] == [f"/v1/scenes/{NOBODYS}"] * 2

    asyncio.run(test())


def test_known_siblings_are_asked_while_the_head_of_the_cluster_does_not_answer(monkeypatch):
    monkeypatch.setattr(module, "FRESH_S", 0.0)

    async def test():
        head = asyncio.Event()
        head.set()

        async def listed():
            await head.wait()
            return ["http://other"]

        client = httpx.AsyncClient(transport=httpx.MockTransport(lambda request: httpx.Response(200)))
        peers = Peers(listed, None, client)
        assert await peers.owner("x") == "http://other"
        head.clear()
        for _ in range(3):
            assert await asyncio.wait_for(peers.owner("x"), HANG_S) == "http://other"
            await asyncio.sleep(0)
        await peers.close()

    asyncio.run(test())


def test_requests_go_on_byte_by_byte(services, other):
    """Whatever a client sends or leaves out, the answer is that of the service that has the scene."""
    (first, *_), _ = services
    second, id = other
    answers = []
    for asked_at in (first, second):
        host, port = asked_at.base_url.host, asked_at.base_url.port
        with socket.create_connection((host, port)) as sent:
            token = "".join(
                f"{name}: {value}\r\n" for name, value in asked_at.headers.items() if name == "authorization"
            )
            lines = f"GET /v1/scenes/{id} HTTP/1.1\r\nHost: {host}:{port}\r\nUser-Agent: caf\xe9\r\n"
            sent.sendall(f"{lines}{token}Connection: close, X-Mine\r\nX-Mine: 1\r\n\r\n".encode("latin-1"))
            answers.append(b"".join(iter(lambda: sent.recv(65536), b"")))
    heads = [sorted(answer.partition(b"\r\n\r\n")[0].lower().split(b"\r\n")) for answer in answers]
    names = [[line.partition(b":")[0] for line in head] for head in heads]
    assert names[0] == names[1]
    assert answers[1].startswith(b"HTTP/1.1 200")
    assert b"content-encoding" not in names[1]


@pytest.mark.parametrize("path", ["/..", "/../../../health/live", "/%2e%2e", "/."])
def test_paths_with_dots_are_no_address(services, other, path):
    second, id = other
    host, port = second.base_url.host, second.base_url.port
    token = "".join(f"{name}: {value}\r\n" for name, value in second.headers.items() if name == "authorization")
    with socket.create_connection((host, port)) as sent:
        head = f"GET /v1/scenes/{id}{path} HTTP/1.1\r\nHost: {host}:{port}\r\nConnection: close\r\n{token}\r\n"
        sent.sendall(head.encode())
        assert sent.recv(65536).startswith(b"HTTP/1.1 404")


def test_a_slash_too_many_leads_back_to_the_same_service(services, other):
    second, id = other
    answer = second.get(f"/v1/scenes/{id}/")
    assert answer.status_code in (307, 404)
    assert not answer.headers.get("location", "").startswith("http")


class Slow:
    """A peer that has every scene, and answers slowly; it notes what it was told."""

    def __init__(self):
        self.given, self.cut = 0, threading.Event()
        service = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self):
                self.send_response(200)
                self.end_headers()
                if not self.path.endswith("/render"):
                    return
                try:
                    while service.given < 2_000:
                        self.wfile.write(b"x" * 100_000)
                        service.given += 1
                except OSError:
                    service.cut.set()

            def log_message(self, *args):
                pass

        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.server.server_port}"

    def close(self):
        self.server.shutdown()
        self.server.server_close()


def test_a_client_that_hangs_up_is_noticed(services, fresh):
    (_, second, _), _ = services
    slow = Slow()
    GONE.append(slow.url)
    try:
        wait_for(lambda: second.get("/v1/scenes/abcdefabcdef").status_code == 200)
        with second.stream("GET", "/v1/scenes/abcdefabcdef/render") as answer:
            next(answer.iter_raw())
        assert slow.cut.wait(HANG_S)
        assert slow.given < 1_500
    finally:
        GONE.clear()
        slow.close()


def test_a_sibling_is_asked_with_as_much_as_the_client_may():
    peers = asked(lambda request: httpx.Response(404), secret=TOKEN)
    assert peers.headers(ALL)["authorization"] == f"Bearer {TOKEN}"
    read = peers.headers(Permission(scene="x", end=2_000_000_000))["authorization"]
    assert read.startswith("Bearer scas4d.read.x.2000000000.")
    assert np.isclose(int(peers.headers(Permission())["authorization"].split(".")[3]), time.time(), rtol=0.5)
