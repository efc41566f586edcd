"""The service itself under strangers: with a token and without, and while a scene updates."""

from __future__ import annotations

import httpx
import pytest
from attack import attack
from peers import HOST, SHORT, Peer, parsed
from prometheus_client.parser import text_string_to_metric_families
from running import Running, fake_settings, make_rig, pictures, problem
from waiting import HANG_S, wait_for

from client.sdk import Client

TOKEN = "a-token-of-thirty-two-characters"


@pytest.fixture(scope="module", params=[None, TOKEN], ids=["no token", "a token"])
def running(request, tmp_path_factory):
    given = {} if request.param is None else {"token": request.param}
    limits = SHORT | {"header_kb": 64, "max_connections_per_peer": 40}
    service = Running(fake_settings(tmp_path_factory.mktemp("strangers"), **limits, **given))
    service.token = request.param
    yield service
    service.stop()


@pytest.fixture
def sdk(running):
    with Client(running.url, token=running.token, busy_timeout=HANG_S) as client:
        yield client


def counted(running, name):
    """Samples of a metric by their label."""
    bearer = {"Authorization": f"Bearer {running.token}"}
    text = httpx.get(f"{running.url}/metrics", headers=bearer, timeout=HANG_S).text
    families = text_string_to_metric_families(text)
    return {
        next(iter(sample.labels.values())): sample.value
        for family in families
        for sample in family.samples
        if sample.name == name
    }


def test_nobody_without_a_token_can_stop_it(running, sdk):
    scene = sdk.create_scene(make_rig()).id
    before = counted(running, "scas4d_connections_refused_total")
    path = f"/v1/scenes/{scene}/frames/9"
    sdk.put_frame(scene, 0, pictures())
    found = attack(running.port, path, header=50_000_000, halves=0, uploads=0, patience=HANG_S)
    assert found["open"] == 0
    assert found["sent"] < 30_000_000
    attack(running.port, path, header=0, halves=60, uploads=60, patience=0.3)
    for index in range(1, 6):
        sdk.put_frame(scene, index, pictures())
        assert httpx.get(f"{running.url}/health/live", timeout=HANG_S).status_code == 200
        sdk.wait(scene, index)
    ended = attack(running.port, path, header=50_000_000, halves=60, uploads=60, patience=HANG_S)
    assert ended["open"] == 0
    after = counted(running, "scas4d_connections_refused_total")
    risen = {reason for reason, count in after.items() if count > before[reason]}
    assert {"head_size", "displaced"} <= risen
    sdk.delete_scene(scene)


def test_open_connections_are_counted_by_kind(running):
    with Peer(running.port) as peer:
        peer.send(b"GET / HTTP/1.1\r\n")
        wait_for(lambda: counted(running, "scas4d_connections")["header"] == 1)
        assert counted(running, "scas4d_connections")["answer"] == 1  # the question itself
        peer.rest()
    wait_for(lambda: counted(running, "scas4d_connections")["header"] == 0)


def test_a_hanging_upload_ends_with_an_answer(running):
    with Peer(running.port) as peer:
        peer.send(b"POST /v1/scenes HTTP/1.1\r\n" + HOST + b"Content-Length: 99\r\n\r\n{")
        assert parsed(peer.rest())[0] == (401 if running.token else 408)


def test_an_upload_without_the_token_reads_why(running):
    if running.token is None:
        pytest.skip("there is no token")
    for close in ({}, {"Connection": "close"}):
        answer = httpx.put(
            f"{running.url}/v1/scenes/x/frames/0", content=bytes(1_900_000), headers=close, timeout=HANG_S
        )
        problem(answer, 401)


def test_a_client_of_a_proxy_on_this_machine_is_not_on_this_machine(tmp_path):
    service = Running(fake_settings(tmp_path, trusted_proxies="127.0.0.1"))
    try:
        assert httpx.get(f"{service.url}/v1/scenes", timeout=HANG_S).status_code == 200
        forwarded = {"X-Forwarded-For": "203.0.113.7"}
        problem(httpx.get(f"{service.url}/v1/scenes", headers=forwarded, timeout=HANG_S), 403)
    finally:
        service.stop()
