"""What the client says about a service that does not respond: what happened, and no cause that is not known."""

from __future__ import annotations

import socket
import threading

import httpx
import pytest

from client.cli import main
from client.errors import NotFound, ServiceError, ServiceUnreachable, unreachable
from client.ingest import IngestSocket
from client.sdk import Client

PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY")


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch):
    for name in PROXIES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)


@pytest.fixture
def closed_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        yield probe.getsockname()[1]  # bound, but not listening


@pytest.fixture
def plain_server():
    """Answers each connection with a few bytes that are neither TLS nor a response, and closes it."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer():
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection:
                    connection.recv(1000)
                    connection.sendall(b"220 mail.example.org ready\r\n")

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
    thread.join()


def said(url, **options):
    with pytest.raises(ServiceUnreachable) as caught, Client(url, outage=0, **options) as client:
        client.live()
    return str(caught.value), caught.value.refused


def test_a_refused_connection(closed_port):
    text, refused = said(f"http://127.0.0.1:{closed_port}")
    assert text == f"http://127.0.0.1:{closed_port} cannot be reached: the connection was refused"
    assert refused


def test_a_refused_websocket(closed_port):
    client = Client(f"http://127.0.0.1:{closed_port}", outage=0)
    with pytest.raises(ServiceUnreachable, match="the connection was refused"), IngestSocket(client, "s") as sender:
        sender.put_frame(0, {"a": b"x"})


def test_tls_with_a_service_that_has_none(plain_server):
    text, refused = said(f"https://127.0.0.1:{plain_server}")
    assert "was reached, but the TLS handshake failed" in text
    assert "use http://" in text
    assert not refused


def test_a_server_that_speaks_another_protocol(plain_server):
    text, refused = said(f"http://127.0.0.1:{plain_server}")
    assert text.startswith(f"the connection to http://127.0.0.1:{plain_server} was lost: ")
    assert not refused


def test_a_proxy_of_the_environment_is_named(closed_port, monkeypatch):
    monkeypatch.setenv("HTTP_PROXY", f"http://user:secret@127.0.0.1:{closed_port}")
    text, refused = said("http://scas4d.example")
    assert text.endswith(f"through the proxy 127.0.0.1:{closed_port}, from the environment")
    assert "secret" not in text
    assert not refused
    websocket = unreachable("ws://scas4d.example/v1/scenes/s/stream", ConnectionRefusedError(111, "refused"))
    assert str(websocket).endswith(f"through the proxy 127.0.0.1:{closed_port}, from the environment")
    assert not websocket.refused


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (httpx.ConnectTimeout("timed out"), "no connection was made in time; the host or a firewall does not respond"),
        (httpx.ReadTimeout("timed out"), "http://nowhere did not respond in time (timed out)"),
        (httpx.ReadError("reset"), "the connection to http://nowhere was lost: reset"),
        (httpx.RemoteProtocolError("closed"), "the connection to http://nowhere was lost: closed"),
        (httpx.ConnectError("down"), "http://nowhere cannot be reached: down"),
        (httpx.ProxyError("407"), "http://nowhere cannot be reached, because the proxy failed: 407"),
    ],
)
def test_other_failures(error, expected):
    def fail(request):
        raise error

    assert expected in said("http://nowhere", transport=httpx.MockTransport(fail))[0]


def test_a_host_that_has_no_address():
    def fail(request):
        raise httpx.ConnectError("unknown") from socket.gaierror(-2, "Name or service not known")

    assert "its host name could not be resolved" in said("http://nowhere", transport=httpx.MockTransport(fail))[0]


def test_a_response_of_another_server_is_not_taken_for_the_service():
    transport = httpx.MockTransport(lambda request: httpx.Response(404, text="<html>nginx</html>"))
    with Client("http://nowhere", transport=transport) as client, pytest.raises(NotFound) as caught:
        client.scene("s")
    assert "404: unexpected response, which is not from the service but perhaps from a proxy" in str(caught.value)


@pytest.mark.parametrize("read", [lambda client: client.scene("s"), lambda client: client.render("s", "c0")])
@pytest.mark.parametrize("text", ["<html>nginx</html>", "{}"])
def test_a_success_of_another_server_is_not_taken_for_the_service(read, text):
    transport = httpx.MockTransport(lambda request: httpx.Response(200, text=text))
    with Client("http://nowhere", transport=transport) as client, pytest.raises(ServiceError) as caught:
        read(client)
    assert str(caught.value).startswith("200: unexpected response, which is not from the service but perhaps")
    assert str(caught.value).endswith(text)


def test_the_command_advises_to_start_a_service_only_if_nothing_listens(closed_port, plain_server, monkeypatch):
    def output(port):
        monkeypatch.setattr("sys.argv", ["scas4d", "scenes", "--url", f"http://127.0.0.1:{port}"])
        with pytest.raises(SystemExit) as caught:
            main.main()
        return str(caught.value)

    assert "start a service with: scas4d serve" in output(closed_port)
    assert "start a service" not in output(plain_server)
