"""`scas4d serve` as a process: what it says when it starts, and when it cannot."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import signal
import socket
import subprocess
import sys
import time

import fakes
import httpx
import pytest
from waiting import HANG_S

from server.serve import address, listen
from server.storage.disk import FolderLock

pytestmark = pytest.mark.service

ENVIRONMENT = fakes.environment(SCAS4D_WARM_UP="false")


def command(folder, port, host="127.0.0.1"):
    return [
        sys.executable,
        "-m",
        "client.cli.main",
        "serve",
        "--host",
        host,
        "--port",
        str(port),
        "--data",
        str(folder),
    ]


def refused(folder, port, host="127.0.0.1"):
    done = subprocess.run(
        command(folder, port, host), capture_output=True, text=True, timeout=HANG_S, env=ENVIRONMENT, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("scas4d: ")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


@pytest.fixture
def taken():
    """A port at which somebody listens."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


def test_a_port_in_use_is_one_line(taken, tmp_path):
    said = refused(tmp_path, taken)
    assert f"port {taken} of 127.0.0.1 is in use" in said
    assert "--port" in said


def test_a_data_folder_in_use_is_one_line(tmp_path):
    lock = FolderLock(tmp_path / "service.lock", wait=False)
    said = refused(tmp_path, 0)
    lock.release()
    assert f"another service is using {tmp_path}" in said
    assert "--data" in said


def test_a_data_folder_that_cannot_be_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    assert "choose another one with --data" in refused(tmp_path / "file", 0)


def test_a_host_of_another_machine_is_one_line(tmp_path):
    with pytest.raises(RuntimeError, match=r"cannot listen on 192\.0\.2\.1"):  # of a network for documents
        listen("192.0.2.1", 0)


def test_every_address_of_a_name_has_one_port():
    sockets = listen("localhost", 0)
    try:
        assert len({opened.getsockname()[1] for opened in sockets}) == 1
        assert address("0.0.0.0", sockets) == f"http://127.0.0.1:{sockets[0].getsockname()[1]}"
        assert address("::1", sockets).startswith("http://[::1]:")
    finally:
        for opened in sockets:
            opened.close()


def answering(port):
    until = time.monotonic() + HANG_S
    while True:
        with contextlib.suppress(httpx.TransportError):
            return httpx.get(f"http://127.0.0.1:{port}/v1/scenes", timeout=HANG_S)
        assert time.monotonic() < until
        time.sleep(0.05)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize("terminal", [True, False])
def test_plain_lines_in_a_terminal_and_json_elsewhere(tmp_path, terminal):
    port = free_port()
    reading, writing = pty.openpty() if terminal else os.pipe()
    process = subprocess.Popen(command(tmp_path, port), stderr=writing, env=ENVIRONMENT)
    os.close(writing)
    try:
        assert answering(port).status_code == 200
        assert httpx.delete(f"http://127.0.0.1:{port}/v1/scenes/none", timeout=HANG_S).status_code == 404
    finally:
        process.send_signal(signal.SIGINT)
    said = b""
    with contextlib.suppress(OSError):  # how a terminal says that nobody is there any more
        while piece := os.read(reading, 4096):
            said += piece
    os.close(reading)
    assert process.wait(HANG_S) == 0
    lines = said.decode().splitlines()
    if terminal:
        assert f"viewer at http://127.0.0.1:{port}, scenes in {tmp_path}" in lines[0]
        assert [line.split(" ", 1)[1] for line in lines[1:]] == ["DELETE /v1/scenes/none 404", "stopped"]
    else:
        messages = [json.loads(line)["message"] for line in lines]
        assert "GET /v1/scenes 200" in messages
        assert any(f"http://127.0.0.1:{port}" in message for message in messages)
