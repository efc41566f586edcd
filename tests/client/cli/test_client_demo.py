"""`scas4d demo`: what it waits for, what it leaves, and what it says where it cannot go on."""

from __future__ import annotations

import io
import re
import signal
import subprocess
import sys

import fakes
import httpx
import numpy as np
import pytest
from PIL import Image
from running import HEIGHT, WIDTH
from waiting import HANG_S

from client.cli import demo as demo_command
from client.cli.demo import _compile_progress, running_service
from client.errors import ServiceError
from client.sdk import Client
from client.wire.service import Health, ProblemDetails
from scas4d_core.captures import open_capture
from server.storage.disk import FolderLock

pytestmark = pytest.mark.service

SLOW = """
import time
import fakes

fakes.install(warm_up=lambda told: time.sleep(3))
"""


def demo(capture, out, *more, before=(), **environment):
    return subprocess.run(
        [sys.executable, "-m", "client.cli.main", "demo", "--capture", str(capture), "--out", str(out), *more],
        capture_output=True,
        text=True,
        timeout=HANG_S,
        env=fakes.environment(*before, TERM="dumb", **environment),
    )


@pytest.fixture(scope="module")
def done(capture_folder, tmp_path_factory):
    """A demo whose kernels take their time; the folder it left, and what it said."""
    folder = tmp_path_factory.mktemp("demo")
    (folder / "sitecustomize.py").write_text(SLOW)
    ended = demo(capture_folder, folder / "out", before=[folder])
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return folder / "out", ended.stdout


def test_it_waits_for_the_kernels_and_leaves_pictures(done):
    out, said = done
    assert said.startswith("preparing the kernels\n")
    assert "http://127.0.0.1:" in said
    assert "dB PSNR" in said
    pictures = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.png"))
    assert pictures == [*(f"camera_2/{t:06d}.png" for t in range(4)), "depth.png", "parts.png"]
    with Image.open(out / "camera_2/000001.png") as picture:
        assert picture.size == (3 * WIDTH, HEIGHT)


def test_its_service_ends_with_it(tmp_path):
    script = f"""
import time
from pathlib import Path
from client.cli.demo import running_service
with running_service(Path({str(tmp_path / "data")!r}), Path({str(tmp_path / "log")!r})) as url:
    print("url", url, flush=True)
    time.sleep({HANG_S})
"""
    command = [sys.executable, "-c", script]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=fakes.environment(TERM="dumb")) as process:
        url = next(line.split()[1] for line in process.stdout if line.startswith("url"))
        assert httpx.get(f"{url}/health/live").status_code == 200
        process.terminate()
        assert process.wait(HANG_S) == 128 + signal.SIGTERM
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{url}/health/live")


def test_its_scene_can_be_looked_at_later_and_its_parts_have_the_colours_of_the_service(
    done, capture_folder, tmp_path, monkeypatch
):
    out, said = done
    id = re.search(rf"scas4d serve --data {out / 'data'}, then open \S+/#scene=(\w+)", said)[1]
    monkeypatch.setenv("PYTHONPATH", fakes.environment()["PYTHONPATH"])
    camera = open_capture(capture_folder).full_test_rig.cameras[0]
    with running_service(out / "data", tmp_path / "log") as url, Client(url) as client:
        assert client.scene(id).committed == 4
        file = client.render_file(id, camera, None, kind="parts", format="png")
    with Image.open(io.BytesIO(file)) as found, Image.open(out / "parts.png") as left:
        assert np.array_equal(found.convert("RGB"), left.convert("RGB"))
        assert np.any(left)


@pytest.mark.parametrize(
    "said",
    [{"warming_up": True}, {"warming_up": True, "kernels_compiled": 3, "kernels": 18}, {"recovering": ["k3"]}, {}],
)
def test_it_waits_for_what_will_be_ready_without_anybodys_doing(said, tmp_path, monkeypatch):
    def not_ready(client):
        raise ServiceError(ProblemDetails(title="not ready", status=503, detail="not yet", **said))

    monkeypatch.setattr(Client, "live", lambda client: Health(status="live", version="", scenes=0, process=7))
    monkeypatch.setattr(Client, "ready", not_ready)
    if said:
        assert _compile_progress("http://127.0.0.1:1", tmp_path, 7) == (
            said.get("kernels_compiled", 0),
            said.get("kernels", 1),
        )
    else:
        with pytest.raises(RuntimeError, match="failed to become ready: 503: not yet"):
            _compile_progress("http://127.0.0.1:1", tmp_path, 7)


def test_a_service_that_takes_the_port_in_the_meantime_is_not_used(service, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", fakes.environment()["PYTHONPATH"])
    monkeypatch.setattr(demo_command, "_free", lambda port: port)  # it was free when the demo looked
    with (
        pytest.raises(RuntimeError, match=f"the service exited: port {service.port} of 127.0.0.1 is in use"),
        running_service(tmp_path / "data", tmp_path / "log", service.port),
    ):
        pytest.fail("the demo would delete scenes of another service")


def test_another_demo_takes_the_place_of_the_one_before(capture_folder, tmp_path):
    for _ in range(2):
        ended = demo(capture_folder, tmp_path / "out", "--frames", "1", SCAS4D_MAX_SCENES="1")
        assert ended.returncode == 0, ended.stdout + ended.stderr


def test_a_token_in_the_environment_is_used(capture_folder, tmp_path):
    token = "a-token-of-thirty-two-characters"
    ended = demo(capture_folder, tmp_path / "out", "--frames", "1", SCAS4D_TOKEN=token)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_a_service_that_ends_is_told_with_its_reason(capture_folder, tmp_path):
    (tmp_path / "out" / "data").mkdir(parents=True)
    lock = FolderLock(tmp_path / "out" / "data" / "service.lock", wait=False)
    ended = demo(capture_folder, tmp_path / "out")
    lock.release()
    assert ended.returncode == 1
    assert ended.stderr.startswith("scas4d: the service exited: another service is using ")
    assert ended.stderr.count("\n") == 1


def test_kernels_that_cannot_be_made_are_not_waited_for(capture_folder, tmp_path):
    ended = demo(capture_folder, tmp_path / "out", FAKE_FAULT="1")
    assert ended.returncode == 1
    assert ended.stderr.startswith("scas4d: the service failed to become ready: 503")
    assert "the fake was told to raise" in ended.stderr
    assert ended.stderr.count("\n") == 1
