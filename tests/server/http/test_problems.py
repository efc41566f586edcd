"""What the framework refuses by itself is a problem document too."""

from __future__ import annotations

import gzip
import re
import socket

import httpx
import pytest
from running import problem
from waiting import HANG_S


def test_an_unknown_address(http):
    document = problem(http.get("/v1/nowhere"), 404)
    assert (document["field"], document["value"]) == ("path", "/v1/nowhere")
    assert "openapi" in document["remedy"]


def test_a_method_that_is_not_there_names_those_that_are(http, quiet_scene):
    answer = http.put(f"/v1/scenes/{quiet_scene}")
    assert problem(answer, 405)["value"] == "PUT"
    assert answer.headers["allow"] == "DELETE, GET, PATCH"
    assert "GET" in answer.json()["remedy"]


@pytest.mark.parametrize("kind", ["text/plain", "application/xml", "multipart/form-data; boundary=x"])
def test_a_body_of_another_kind(http, kind):
    for path in ("/v1/scenes", "/v1/estimate"):
        document = problem(http.post(path, content="{}", headers={"Content-Type": kind}), 415)
        assert document["field"] == "Content-Type"


@pytest.mark.parametrize("coding", ["gzip", "br", "deflate, gzip", "x"])
def test_a_compressed_body_is_refused_by_name_on_every_route(http, coding):
    document = http.get("/openapi.json").json()
    routes = [(method, path) for path, methods in document["paths"].items() for method in methods if method != "get"]
    assert len(routes) > 20
    for method, path in routes:
        url = re.sub(r"{\w+}", "0", path)
        answer = http.request(method, url, content=gzip.compress(b"{}"), headers={"Content-Encoding": coding})
        assert (problem(answer, 415)["field"], answer.json()["value"]) == ("Content-Encoding", coding)
        assert answer.headers["accept-encoding"] == "identity"
        assert "without Content-Encoding" in answer.json()["remedy"]


def test_the_coding_identity_changes_nothing(http):
    headers = {"Content-Type": "application/json", "Content-Encoding": "Identity"}
    assert problem(http.post("/v1/scenes", content="{}", headers=headers), 422)["field"] == "body.rig"


def test_a_body_that_is_too_large_by_its_length_or_while_it_comes(http, service):
    limit = int(service.app.state.settings.max_body_mb * 1e6)
    headers = {"Content-Type": "application/json"}
    with socket.create_connection(("127.0.0.1", service.port)) as raw:  # refused before anything of it is sent
        lines = ["POST /v1/scenes HTTP/1.1", "Host: localhost", "Connection: close", f"Content-Length: {limit + 1}"]
        raw.sendall("\r\n".join([*lines, "", ""]).encode())
        raw.settimeout(HANG_S)
        answer = b"".join(iter(lambda: raw.recv(65536), b""))
    assert answer.startswith(b"HTTP/1.1 413")
    assert b"SCAS4D_MAX_BODY_MB" in answer

    def endless():
        for _ in range(limit // 65536 + 2):
            yield b" " * 65536

    try:
        answer = http.post("/v1/scenes", content=endless(), headers=headers)
    except httpx.TransportError:  # it may stop reading before all is sent
        return
    problem(answer, 413)


def test_an_address_that_is_a_websocket(http, quiet_scene):
    for name in ("stream", "ingest"):
        answer = http.get(f"/v1/scenes/{quiet_scene}/{name}")
        assert problem(answer, 426)["field"] == "Upgrade"
        assert answer.headers["upgrade"] == "websocket"


def test_a_fault_of_the_service_names_no_more_than_its_kind(service, monkeypatch):
    def fails(*_):
        raise KeyError("an inner secret")

    monkeypatch.setattr("server.scene.scenes.Scenes.refuse", fails)
    document = problem(httpx.get(f"{service.url}/v1/scenes/x", timeout=HANG_S), 500)
    assert "KeyError" in document["detail"]
    assert "secret" not in str(document)


def test_the_place_of_a_json_error_is_named_once(http):
    answer = http.post("/v1/scenes", content='{"name": "open', headers={"Content-Type": "application/json"})
    assert problem(answer, 422)["detail"] == "the body is not valid JSON: unterminated string starting at character 9"
