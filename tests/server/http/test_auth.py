"""Who is let in: the address, Host, Origin, tokens, tickets; HTTP and WebSocket, over a real socket."""

from __future__ import annotations

import asyncio
import json
import re
import socket

import httpx
import pytest
import websockets
from itsdangerous import Signer
from running import Running, fake_settings, make_rig, problem
from waiting import HANG_S

from client.wire import RigModel
from client.wire.stream import STREAM_PROTOCOL
from server.http import tickets as tickets_module
from server.http.authentication import AuthMiddleware
from server.http.origin import check_origin
from server.http.permissions import ALL, Permission
from server.http.sharing import HMAC_SHA256, Sharing
from server.http.tickets import SUBPROTOCOL, Tickets
from server.settings import ServerSettings, SettingsError

TOKEN = "a-token-of-thirty-two-characters"
BEARER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A service with a token, a name of its own, and another site that may use it."""
    settings = fake_settings(
        tmp_path_factory.mktemp("guarded"),
        token=TOKEN,
        allowed_hosts="studio.example, proxied.example:8443",
        allowed_origins="https://viewer.example",
    )
    running = Running(settings)
    yield running
    running.stop()


@pytest.fixture(scope="module")
def listened(guarded):
    """A scene of it, to stream from."""
    body = {"rig": RigModel.of(make_rig()).model_dump(mode="json")}
    created = httpx.post(f"{guarded.url}/v1/scenes", json=body, headers=BEARER, timeout=HANG_S)
    yield created.json()["id"]
    httpx.delete(guarded.url + created.headers["Location"], headers=BEARER, timeout=HANG_S)


def get(running, path="/v1/scenes", **headers):
    return httpx.get(
        running.url + path, headers={name.replace("_", "-"): value for name, value in headers.items()}, timeout=HANG_S
    )


# Host and Origin.


@pytest.mark.parametrize(
    "host", ["localhost", "LOCALHOST:9", "127.0.0.1", "127.8.9.1:80", "[::1]", "[::1]:8000", "localhost."]
)
def test_names_of_the_loopback_are_ours(service, host):
    assert get(service, Host=host).status_code == 200


REBOUND = ["evil.example", "evil.example:8000", "localhost.evil.example", "127.0.0.1.evil.example", "10.0.0.1"]


@pytest.mark.parametrize("host", REBOUND)
@pytest.mark.parametrize("path", ["/", "/v1/scenes", "/health/live", "/metrics", "/openapi.json", "/nowhere"])
def test_a_rebound_host_is_refused(service, host, path):
    document = problem(get(service, path, Host=host), 421)
    assert (document["field"], document["value"]) == ("Host", host)
    # Its page is of the same origin as far as the browser knows.
    problem(get(service, path, Host=host, Origin=f"http://{host}"), 421)


@pytest.mark.parametrize(
    "host", ["", "a b", "localhost:port", "user@localhost", "localhost/path", "[::1", "localhost?"]
)
def test_a_host_that_is_none_is_refused(service, host):
    with socket.create_connection(("127.0.0.1", service.port)) as raw:
        raw.sendall(f"GET /health/live HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
        answer = b"".join(iter(lambda: raw.recv(4096), b""))
    assert answer.startswith((b"HTTP/1.1 400", b"HTTP/1.1 421")), answer


def test_names_that_were_configured_are_ours(guarded):
    for host, status in {
        "studio.example": 200,
        "Studio.Example:1234": 200,
        "proxied.example:8443": 200,
        "proxied.example": 421,
        "proxied.example:80": 421,
        "other.example": 421,
    }.items():
        assert get(guarded, Host=host, **BEARER).status_code == status, host


FOREIGN = ["https://evil.example", "http://localhost:1", "http://127.0.0.1", "null", "file://", "", "http://[::1"]


@pytest.mark.parametrize("page", FOREIGN)
def test_a_cross_origin_page_is_refused(service, page):
    for method in ("GET", "POST", "OPTIONS", "DELETE"):
        answer = httpx.request(method, f"{service.url}/v1/scenes", headers={"Origin": page}, timeout=HANG_S)
        assert problem(answer, 403)["field"] == "Origin"


def test_the_service_s_own_page_and_an_allowed_one_are_let_in(service, guarded):
    assert get(service, Origin=service.url).status_code == 200
    named = f"localhost:{service.port}"
    assert get(service, Origin=f"http://{named}", Host=named).status_code == 200
    assert get(service, Origin="http://localhost", Host="localhost").status_code == 200
    assert get(guarded, Origin="https://studio.example", Host="studio.example", **BEARER).status_code == 200
    answer = get(guarded, Origin="https://viewer.example", **BEARER)
    assert answer.headers["access-control-allow-origin"] == "https://viewer.example"
    asked = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "authorization"}
    preflight = httpx.options(f"{guarded.url}/v1/scenes", headers={"Origin": "https://viewer.example", **asked})
    assert preflight.status_code == 200
    assert "access-control-allow-credentials" not in preflight.headers
    problem(httpx.options(f"{guarded.url}/v1/scenes", headers={"Origin": "https://evil.example", **asked}), 403)


def test_pictures_and_frames_of_other_sites_are_refused_and_links_are_not(service):
    picture = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors", "Sec_Fetch_Dest": "image"}
    assert problem(get(service, "/docs/reference.html", **picture), 403)["field"] == "Sec-Fetch-Site"
    problem(get(service, "/docs/reference.html", **picture | {"Sec_Fetch_Site": "same-site"}), 403)
    assert get(service, "/docs/reference.html", **picture | {"Sec_Fetch_Site": "same-origin"}).status_code == 200
    link = {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate", "Sec_Fetch_Dest": "document"}
    answer = get(service, "/docs/reference.html", **link)
    assert answer.status_code == 200
    assert answer.headers["x-frame-options"] == "DENY"
    problem(get(service, "/docs/reference.html", **link | {"Sec_Fetch_Dest": "iframe"}), 403)
    form = httpx.post(
        f"{service.url}/v1/scenes", headers={k.replace("_", "-"): v for k, v in link.items()}, timeout=HANG_S
    )
    problem(form, 403)


def test_without_a_token_only_this_machine_reaches_it():
    """However it was started: the address that a request came in at is beyond the loopback."""
    answered = []

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def send(message):
        answered.append(message)

    def ask(address, token=None):
        headers = [(b"host", b"localhost")] + ([(b"authorization", f"Bearer {token}".encode())] if token else [])
        scope = {"type": "http", "path": "/", "method": "GET", "headers": headers, "server": (address, 80)}
        answered.clear()
        asyncio.run(AuthMiddleware(app, ServerSettings(token=token), Tickets())(scope, None, send))
        return answered[0]["status"]

    assert ask("10.0.0.7") == 403
    assert ask("127.0.0.1") == ask("::1") == 200
    assert ask("10.0.0.7", TOKEN) == 200


def test_an_address_that_was_connected_to_is_a_name_of_ours():
    scope = {"type": "http", "headers": [(b"host", b"10.0.0.7:8000")], "server": ("10.0.0.7", 8000), "method": "GET"}
    check_origin(scope, (), ())
    with pytest.raises(Exception, match="name"):
        check_origin(scope | {"server": ("10.0.0.8", 8000)}, (), ())


# Tokens.


WRONG = [
    "",
    "Bearer",
    "Bearer wrong",
    f"Bearer {TOKEN}x",
    f"Bearer {TOKEN[:-1]}",
    f"Basic {TOKEN}",
    TOKEN,
    "Bearer \xff",
]


@pytest.mark.parametrize("given", WRONG)
def test_a_wrong_token_is_refused(guarded, given):
    answer = httpx.get(f"{guarded.url}/v1/scenes", headers={"Authorization": given.encode("latin-1")}, timeout=HANG_S)
    document = problem(answer, 401)
    assert document["field"] == "Authorization"
    assert answer.headers["www-authenticate"].startswith("Bearer")
    assert TOKEN not in answer.text


def test_everything_but_what_bears_no_data_is_behind_the_token(guarded):
    probes = {"/health/live", "/health/ready", "/health/ingest"}
    paths = set(get(guarded, "/openapi.json").json()["paths"])
    assert probes <= paths
    for path in probes:
        assert get(guarded, path).status_code == 200
    for path in paths - probes:
        problem(get(guarded, re.sub(r"{\w+}", "0", path)), 401)
    for path in ("/metrics", "/health/other", "/v1", "/nowhere", "/viewerx", "//v1/scenes"):
        problem(get(guarded, path), 401)
        assert get(guarded, path, **BEARER).status_code in (200, 404)
    problem(
        httpx.get(f"{guarded.url}/v1/scenes", headers=[("Authorization", BEARER["Authorization"])] * 2, timeout=HANG_S),
        401,
    )


def test_a_secret_in_an_address_is_refused(guarded):
    for name in ("token", "access_token", "Ticket"):
        document = problem(get(guarded, f"/v1/scenes?{name}={TOKEN}", **BEARER), 400)
        assert document["field"] == name
        assert TOKEN not in json.dumps(document)


# WebSockets.


def connect(running, id, protocols=(STREAM_PROTOCOL,), **options):
    """The subprotocol that was accepted, or the problem document that refused the handshake."""

    async def run():
        address = running.url.replace("http", "ws") + f"/v1/scenes/{id}/stream"
        try:
            async with websockets.connect(address, subprotocols=list(protocols), **options) as socket:
                await asyncio.wait_for(socket.recv(), HANG_S)
                return socket.subprotocol
        except websockets.InvalidStatus as refused:
            return json.loads(refused.response.body)  # no problem document is not valid JSON

    return asyncio.run(run())


def ticket(running):
    return httpx.post(f"{running.url}/v1/tickets", headers=BEARER, timeout=HANG_S).json()


def test_a_websocket_without_a_token_is_refused(guarded, listened):
    assert connect(guarded, listened)["status"] == 401
    assert connect(guarded, listened, additional_headers={"Authorization": "Bearer no"})["status"] == 401
    assert connect(guarded, listened, additional_headers=BEARER) == STREAM_PROTOCOL


def test_a_ticket_opens_one_websocket(guarded, listened):
    problem(httpx.post(f"{guarded.url}/v1/tickets", timeout=HANG_S), 401)
    issued = ticket(guarded)
    assert issued["subprotocol"] == SUBPROTOCOL + issued["ticket"]
    offered = (STREAM_PROTOCOL, issued["subprotocol"])
    assert connect(guarded, listened, offered, origin=guarded.url) == STREAM_PROTOCOL
    refused = connect(guarded, listened, offered)
    assert (refused["status"], refused["field"]) == (401, "Sec-WebSocket-Protocol")
    assert issued["ticket"] not in json.dumps(refused)
    assert connect(guarded, listened, (STREAM_PROTOCOL, SUBPROTOCOL + "made-up"))["status"] == 401
    two = ticket(guarded)["subprotocol"], ticket(guarded)["subprotocol"]
    assert connect(guarded, listened, (STREAM_PROTOCOL, *two))["status"] == 401
    # A ticket is for a WebSocket, not for requests.
    problem(httpx.get(f"{guarded.url}/v1/scenes", headers={"Authorization": "Bearer " + two[0]}, timeout=HANG_S), 401)


def test_a_ticket_alone_is_echoed_so_that_browsers_accept_the_handshake():
    sent = []

    async def app(scope, receive, send):
        assert scope["subprotocols"] == []
        assert b"secret" not in b"".join(value for _, value in scope["headers"])
        await send({"type": "websocket.accept"})

    async def send(message):
        sent.append(message)

    tickets = Tickets(TOKEN)
    offered = SUBPROTOCOL + tickets.issue()
    scope = {
        "type": "websocket",
        "path": "/",
        "headers": [(b"host", b"localhost"), (b"sec-websocket-protocol", b"scas4d.ticket.secret")],
        "subprotocols": [offered],
        "extensions": {"websocket.http.response": {}},
    }
    asyncio.run(AuthMiddleware(app, ServerSettings(token=TOKEN), tickets)(scope, None, send))
    assert sent == [{"type": "websocket.accept", "subprotocol": offered}]


@pytest.mark.parametrize("page", ["https://evil.example", "null", "http://localhost:1"])
def test_a_cross_origin_websocket_is_refused(service, guarded, listened, page):
    assert connect(service, "none", origin=page)["status"] == 403
    assert connect(guarded, listened, additional_headers=BEARER, origin=page)["status"] == 403
    issued = ticket(guarded)["subprotocol"]
    assert connect(guarded, listened, (STREAM_PROTOCOL, issued), origin=page)["status"] == 403
    # What was refused for its origin has not used the ticket up.
    assert connect(guarded, listened, (STREAM_PROTOCOL, issued), origin="https://viewer.example") == STREAM_PROTOCOL


def handshake(running, path, host):
    with socket.create_connection(("127.0.0.1", running.port)) as raw:
        lines = [f"GET {path} HTTP/1.1", f"Host: {host}", f"Origin: http://{host}", "Upgrade: websocket"]
        lines += ["Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]
        lines += [f"Sec-WebSocket-Protocol: {STREAM_PROTOCOL}"]
        raw.sendall("\r\n".join([*lines, "", ""]).encode())
        raw.settimeout(HANG_S)
        return raw.recv(4096).decode()


@pytest.mark.parametrize("host", REBOUND)
def test_a_rebound_websocket_is_refused(service, host):
    assert handshake(service, "/v1/scenes/x/stream", host).startswith("HTTP/1.1 421")


def test_a_websocket_where_there_is_none_gets_a_document(service):
    answer = handshake(service, "/v1/nowhere", "localhost")
    assert answer.startswith("HTTP/1.1 403") or answer.startswith("HTTP/1.1 404")
    problem(get(service, "/v1/scenes/x/stream"), 426)


def test_a_server_that_cannot_answer_a_handshake_closes_it():
    sent = []

    async def send(message):
        sent.append(message)

    scope = {"type": "websocket", "path": "/", "headers": [(b"host", b"evil.example")]}
    asyncio.run(AuthMiddleware(None, ServerSettings(), Tickets())(scope, None, send))
    assert [(message["type"], message["code"]) for message in sent] == [("websocket.close", 1008)]
    assert "name" in sent[0]["reason"]


# Tickets by themselves, and the settings.


def test_tickets_expire_and_the_used_ones_are_bounded(monkeypatch):
    monkeypatch.setattr(tickets_module, "MOST_TICKETS", 2)
    now = [1e9]
    tickets = Tickets(TOKEN, clock=lambda: now[0])
    first, second, third, late = (tickets.issue() for _ in range(4))
    assert tickets.redeem(first)
    assert not tickets.redeem(first)
    assert tickets.redeem(second)
    with pytest.raises(Exception, match=r"2 tickets used \(maximum 2 in 30 s\)"):
        tickets.redeem(third)
    now[0] += 31.0
    assert not tickets.redeem(late)
    assert not tickets.redeem(first)
    assert tickets.redeem(tickets.issue())
    assert len(tickets._used) == 1


@pytest.mark.parametrize(
    "permission", [ALL, Permission(scene="ab12"), Permission(end=2_000_000_000, scene="a.b?x=1.2")]
)
def test_a_ticket_is_known_by_every_service_of_that_token_and_by_no_other(permission):
    ticket = Tickets(TOKEN).issue(permission)
    assert Tickets(TOKEN).redeem(ticket) == permission
    assert Tickets(TOKEN + "x").redeem(ticket) is None
    assert Tickets().redeem(Tickets().issue()) is None
    signature = ticket.rpartition(".")[2]
    changed = Tickets(TOKEN + "x").issue(permission._replace(write=not permission.write)).rpartition(".")[0]
    for other in (f"{changed}.{signature}", "A" + ticket, ticket[:-1], "", ".", "a.b.c.d.e.f", "\udcff.ü"):
        assert Tickets(TOKEN).redeem(other) is None
    of_another_version = Signer(TOKEN, "scas4d tickets", **HMAC_SHA256).sign("number.w.*.0.2000000000").decode()
    assert Tickets(TOKEN).redeem(of_another_version) is None
    assert Sharing(TOKEN).read(ticket) is None  # what opens a WebSocket is no token for reading
    assert Tickets(TOKEN).redeem(Sharing(TOKEN).issue("ab12", 2_000_000_000)) is None


def test_it_listens_beyond_the_loopback_only_with_a_token(tmp_path):
    for host in ("0.0.0.0", "::", "192.168.1.2", "studio.example"):
        with pytest.raises(SettingsError, match="SCAS4D_TOKEN"):
            ServerSettings.from_environment({"SCAS4D_HOST": host})
        assert ServerSettings.from_environment({"SCAS4D_HOST": host, "SCAS4D_TOKEN": TOKEN}).secret == TOKEN
    for host in ("127.0.0.1", "::1", "localhost", "127.3.2.1"):
        ServerSettings.from_environment({"SCAS4D_HOST": host})
    file = tmp_path / "token"
    file.write_text(TOKEN + "\n")
    assert ServerSettings.from_environment({"SCAS4D_TOKEN_FILE": str(file)}, host="0.0.0.0").secret == TOKEN


@pytest.mark.parametrize("weak", ["short", "with spaces in between it", "ä" * 20, "x" * 513])
def test_a_token_that_cannot_be_one_is_refused_and_never_quoted(weak):
    with pytest.raises(SettingsError) as refused:
        ServerSettings.from_environment({"SCAS4D_TOKEN": weak})
    assert weak not in str(refused.value)
    assert TOKEN not in repr(ServerSettings(token=TOKEN))
    assert re.search(r"\*+", repr(ServerSettings(token=TOKEN)))
