"""Pages of other sites in a real browser: nothing of the service reaches them, over HTTP or a WebSocket."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import browser_engine
import pytest
from browser_engine import make_rig
from running import Running, fake_settings
from waiting import HANG_S

from client.sdk import Client
from client.wire.stream import STREAM_PROTOCOL
from studies.machine import browser_path

TOKEN = "a-token-of-thirty-two-characters"

TRY_ALL = """async ([base, id, protocols, headers]) => {
    const read = (path, options) => fetch(base + path, options).then(r => r.text().then(t => r.status), e => "refused");
    const socket = new Promise(done => {
        const ws = new WebSocket(base.replace("http", "ws") + `/v1/scenes/${id}/stream`, protocols);
        ws.onopen = () => { done("open as " + ws.protocol); ws.close(); };
        ws.onerror = () => done("refused");
    });
    const picture = new Promise(done => {
        const image = new Image();
        image.onload = () => done("shown");
        image.onerror = () => done("refused");
        image.src = base + "/viewer/icon.svg";
    });
    return {
        read: await read("/v1/scenes", {headers}),
        blind: await read(`/v1/scenes/${id}/pause`, {mode: "no-cors", method: "POST"}),
        socket: await socket,
        picture: await picture,
    };
}"""


@pytest.fixture(scope="module")
def foreign():
    """Another site on this machine: an empty page."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(b"<!doctype html><title>another site</title>")

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Page)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join(HANG_S)
    server.server_close()


def tried(browser, address, base, id, protocols=(STREAM_PROTOCOL,), headers=None):
    page = browser.new_page()
    try:
        page.goto(address)
        return page.evaluate(TRY_ALL, [base, id, list(protocols), headers or {}])
    finally:
        page.close()


def test_a_page_of_another_site_gets_nothing(chromium, service, finished, foreign):
    found = tried(chromium, foreign, service.url, finished)
    found.pop(
        "blind"
    )  # without CORS a page learns nothing of an answer, good or bad; that nothing happened is seen here
    assert found == {"read": "refused", "socket": "refused", "picture": "refused"}
    with Client(service.url) as sdk:
        assert not sdk.scene(finished).paused


def test_the_service_s_own_page_gets_everything(chromium, service, finished):
    found = tried(chromium, service.url + "/viewer/", service.url, finished)
    assert found == {"read": 200, "blind": 200, "socket": f"open as {STREAM_PROTOCOL}", "picture": "shown"}
    with Client(service.url) as sdk:
        assert sdk.scene(finished).paused
        sdk.resume(finished)


def test_a_name_that_was_pointed_at_this_machine_gets_nothing(chromium, service, finished):
    """DNS rebinding: for the browser, the page and the service are one site."""
    rules = "--host-resolver-rules=MAP evil.example 127.0.0.1"
    browser = chromium.browser_type.launch(executable_path=browser_path(), args=["--no-sandbox", rules])
    try:
        rebound = f"http://evil.example:{service.port}"
        found = tried(browser, rebound + "/viewer/", rebound, finished)
    finally:
        browser.close()
    assert found == {"read": 421, "blind": 421, "socket": "refused", "picture": "refused"}


def test_a_browser_accepts_the_handshake_of_a_ticket(chromium, tmp_path):
    running = Running(fake_settings(tmp_path, token=TOKEN), core=browser_engine.install)
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    try:
        with Client(running.url, token=TOKEN) as sdk:
            id = sdk.create_scene(make_rig()).id
        page = chromium.new_page()
        page.goto(running.url + "/viewer/")
        fetched = "([headers]) => fetch('/v1/tickets', {method: 'POST', headers}).then(r => r.json())"
        ticket = page.evaluate(fetched, [bearer])["subprotocol"]
        page.close()
        without = tried(chromium, running.url + "/viewer/", running.url, id)
        assert (without["read"], without["socket"]) == (401, "refused")
        with_ticket = tried(chromium, running.url + "/viewer/", running.url, id, (STREAM_PROTOCOL, ticket), bearer)
        assert (with_ticket["read"], with_ticket["socket"]) == (200, f"open as {STREAM_PROTOCOL}")
        again = tried(chromium, running.url + "/viewer/", running.url, id, (STREAM_PROTOCOL, ticket))
        assert again["socket"] == "refused"
    finally:
        running.stop()
