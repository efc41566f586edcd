"""The service as a process: how it starts, what it refuses, how it ends; and what cannot leave the data folder."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import fakes
import httpx
import pytest
from running import make_rig, pictures, problem
from waiting import HANG_S

from client.sdk import Client
from client.wire import RigModel

pytestmark = pytest.mark.service

ROOT = Path(__file__).parents[3]
TOKEN = "a-token-of-thirty-two-characters"


@contextmanager
def served(folder, *arguments, **environment):
    """`scas4d serve` with a fake in place of the core at a free port; its process, address and log."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    inherited = {name: value for name, value in fakes.environment().items() if not name.startswith("SCAS4D_")}
    environment = {**inherited, **environment}
    log = folder / "log"
    command = [sys.executable, "-m", "client.cli.main", "serve", "--port", str(port), "--data", str(folder / "data")]
    with log.open("w") as file:
        process = subprocess.Popen([*command, *arguments], env=environment, stderr=file, stdout=file, cwd=folder)
    url = f"http://127.0.0.1:{port}"
    try:
        until = time.monotonic() + HANG_S
        while True:
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < until
            try:
                httpx.get(f"{url}/health/live", timeout=HANG_S)
                break
            except httpx.TransportError:
                time.sleep(0.05)
        yield process, url, log
    finally:
        process.kill()
        process.wait()


def children(pid):
    """Processes of the service, and those of them."""
    found = []
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(FileNotFoundError):  # a thread that ended meanwhile
            for child in task.read_text().split():
                found += [int(child), *children(child)]
    return found


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are counted in /proc")
@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_it_ends_gracefully_in_the_middle_of_an_update(tmp_path, ending):
    with served(tmp_path) as (process, url, log):
        with Client(url) as sdk:
            id = sdk.create_scene(make_rig()).id
            sdk.put_frame(id, 0, pictures())
            sdk.wait(id, 0)
            sdk.put_frame(id, 1, pictures(fakes.SLOW))
            while sdk.scene(id).state != "updating":
                time.sleep(0.02)
        theirs = children(process.pid)
        assert len(theirs) >= 2
        process.send_signal(ending)
        assert process.wait(HANG_S) == 0
        until = time.monotonic() + HANG_S
        while any(Path(f"/proc/{pid}").exists() for pid in theirs):
            assert time.monotonic() < until, "a process outlived the service"
            time.sleep(0.05)
        lines = [json.loads(line) for line in log.read_text().splitlines()]
        assert lines[-1]["message"] == "stopped"
        assert not [line for line in lines if line["level"] == "error"]
    with served(tmp_path) as (process, url, log), Client(url) as sdk:  # everything is there
        assert sdk.wait(id, 1).state == "committed"


def test_every_line_of_its_log_is_json_and_none_holds_the_token(tmp_path):
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    with served(tmp_path, SCAS4D_TOKEN=TOKEN, SCAS4D_TOKKEN="misspelt") as (process, url, log):
        httpx.get(f"{url}/v1/scenes", headers=bearer, timeout=HANG_S)
        httpx.get(f"{url}/v1/scenes?token={TOKEN}", timeout=HANG_S)
        httpx.get(f"{url}/nowhere", headers={"Authorization": f"Bearer {TOKEN}x"}, timeout=HANG_S)
        ticket = httpx.post(f"{url}/v1/tickets", headers=bearer, timeout=HANG_S).json()
        headers = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        headers |= {"Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==", "Sec-WebSocket-Protocol": ticket["subprotocol"]}
        httpx.get(f"{url}/v1/scenes/none/stream?ticket={ticket['ticket']}", headers=headers, timeout=HANG_S)
        process.terminate()
        process.wait(HANG_S)
        text = log.read_text()
    entries = [json.loads(line) for line in text.splitlines()]
    assert {"scas4d.access", "scas4d.server"} <= {entry["logger"] for entry in entries}
    assert any("ignoring unknown setting SCAS4D_TOKKEN" in entry["message"] for entry in entries)
    assert TOKEN not in text
    assert ticket["ticket"] not in text


def test_it_does_not_start_where_it_should_not():
    done = subprocess.run(
        [sys.executable, "-m", "client.cli.main", "serve", "--host", "0.0.0.0"],
        cwd=ROOT, capture_output=True, text=True, timeout=HANG_S,
    )  # fmt: skip
    assert done.returncode == 1
    assert "SCAS4D_TOKEN" in done.stderr
    assert "Traceback" not in done.stderr


# Ids and names that lead out of the data folder.

LEADING_OUT = [
    "..", "../x", "..%2f..%2fx", "%2e%2e", "%2e%2e%2fetc", "..%5c..", ".", "%00", "a%00b", "/etc", "%2fetc%2fpasswd",
    "c0%2f..%2f..", "ä", "%e2%80%ae", "%f0%9f%8e%a5", "a" * 64, "a" * 65, "a" * 5000, "CON", "-rf", "*", "~", "%",
]  # fmt: skip


def tree(folder):
    """What is in the data folder, but for locks that processes take and leave, and files beside it."""
    inside = [path for path in folder.rglob("*") if path.suffix != ".lock"]
    return sorted([*inside, *(path for path in folder.parent.iterdir() if path.is_file())])


def raw(service, method, path, body=b"{}"):
    """The answer to exactly this path: clients tidy paths up before they send them."""
    lines = [f"{method} {path} HTTP/1.1", "Host: localhost", "Connection: close", "Content-Type: application/json"]
    with socket.create_connection(("127.0.0.1", service.port)) as connection:
        connection.settimeout(HANG_S)
        connection.sendall("\r\n".join([*lines, f"Content-Length: {len(body)}", "", ""]).encode() + body)
        return b"".join(iter(lambda: connection.recv(65536), b""))


@pytest.mark.parametrize("id", LEADING_OUT)
def test_an_id_does_not_leave_the_data_folder(service, id):
    before = tree(service.app.state.settings.data)
    for method, path in [
        ("GET", "{}"), ("DELETE", "{}"), ("GET", "{}/render"), ("PUT", "{}/frames/0"), ("PUT", "{}/points"),
        ("GET", "{}/frames/0/splat.ply"), ("POST", "{}/render"), ("GET", "{}/tracks?ids=0"),
    ]:  # fmt: skip
        status = int(raw(service, method, "/v1/scenes/" + path.format(id)).split()[1])
        assert status in (400, 404, 405, 415, 422), (method, path, status)
    assert tree(service.app.state.settings.data) == before


@pytest.mark.parametrize("name", LEADING_OUT)
def test_a_frame_index_and_a_camera_are_checked_likewise(service, quiet_scene, name):
    before = tree(service.app.state.settings.data)
    for path in (f"frames/{name}", f"frames/0/cameras/{name}", f"frames/{name}/splat.ply"):
        for method in ("GET", "PUT"):
            status = int(raw(service, method, f"/v1/scenes/{quiet_scene}/{path}").split()[1])
            assert 400 <= status < 500, (method, path, status)
    assert tree(service.app.state.settings.data) == before


@pytest.mark.parametrize("path", ["/viewer/../v1/scenes", "/viewer/%2e%2e/%2e%2e/settings.py", "/viewer/..%2fapp.py"])
def test_the_page_s_folder_holds_the_page_only(service, path):
    assert int(raw(service, "GET", path).split()[1]) == 404


@pytest.mark.parametrize("name", ["../c", "..", ".", "a/b", "a\\b", "a\0", "ä", "", "x" * 65, "-x", ".x", "a\n"])
def test_a_camera_s_name_is_a_file_s_name_and_no_more(http, name):
    rig = RigModel.of(make_rig()).model_dump(mode="json")
    rig["cameras"][0]["name"] = name
    assert "name" in problem(http.post("/v1/scenes", json={"rig": rig}), 422)["field"]


# Nothing is unpickled.


def test_nothing_is_unpickled():
    """multiprocessing pickles between the service's own processes, over pipes that nobody else can write to."""
    loads = 0
    for package in ("scas4d_core", "server", "client"):
        for path in (ROOT / package).rglob("*.py"):
            text = path.read_text()
            bad = (
                r"^\s*(?:import|from) (?:c?[pP]ickle|dill|cloudpickle|joblib|shelve|marshal)\b|allow_pickle\s*=\s*True"
            )
            assert not re.search(bad, text, re.M), path
            assert not re.search(r"torch\.load\((?![^)]*weights_only\s*=\s*True)", text), path
            assert not re.search(r"\byaml\.(?:unsafe_)?load\(|(?<![.\w])(?:eval|exec)\(", text), path
            loads += len(re.findall(r"\bnp\.load\(", text))
            # numpy's default is not to unpickle since 1.16; it is said all the same.
            for call in re.findall(r"\bnp\.load\((?:[^()]|\([^()]*\))*\)", text):
                assert "allow_pickle=False" in call or "allow_pickle" not in call, (path, call)
    assert loads > 0
