"""The estimate of what a scene takes: against a measurement, and as a limit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import httpx
import numpy as np
import pytest
from running import Running, fake_settings, make_rig, problem
from waiting import HANG_S

from client.wire import RigModel
from scas4d_core.settings import Settings
from server.health.estimate import NOVEL_PIXEL, fit_gpu
from server.problems import Problem
from server.settings import ServerSettings

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("arguments", [("--cameras", "16", "--size", "384"), ("--gaussians", "60000", "--masks")])
def test_the_estimate_is_near_what_is_measured(arguments):
    command = [sys.executable, "-m", "studies", "memory", *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    measured = json.loads(done.stdout.splitlines()[-1])
    assert 0.6 <= measured["ratio"] <= 1.1, measured


def rig(width, count=2):
    model = RigModel.of(make_rig(count)).model_dump(mode="json")
    for camera in model["cameras"]:
        camera["width"] = camera["height"] = width
        camera["intrinsics"] = [[width, 0, width / 2], [0, width, width / 2], [0, 0, 1]]
    return model


def test_an_estimate_creates_nothing(http):
    before = http.get("/v1/scenes").json()
    small, large = (http.post("/v1/estimate", json={"rig": rig(width)}).json() for width in (100, 2000))
    assert http.get("/v1/scenes").json() == before
    assert large["pixels"] == 2 * 2000**2
    assert large["gaussians"] == 100_000
    assert large["memory_mb"] > small["memory_mb"] > 500
    coarse = {"rig": rig(2000), "preset": "fast"}
    assert http.post("/v1/estimate", json=coarse).json()["gaussians"] == 30_000
    scaled = {"rig": rig(2000), "settings": {"scene": {"image_scale": 0.5}, "static": {"max_gaussians": 5000}}}
    found = http.post("/v1/estimate", json=scaled).json()
    assert (found["scaled_pixels"], found["gaussians"]) == (2 * 1000**2, 5000)
    assert found["worker_mb"] == pytest.approx(280 + 150 + found["pictures_mb"] + found["gaussians_mb"], abs=0.1)
    assert large["gpu_mb"] > small["gpu_mb"] > 1000  # two processes
    on_cpu = {"rig": rig(2000), "settings": {"device": "cpu"}}
    assert http.post("/v1/estimate", json=on_cpu).json() == {**large, "gpu_mb": 0.0}
    problem(http.post("/v1/estimate", json={"rig": {}}), 422)


def test_what_the_cameras_say_of_what_is_new_is_counted_where_anything_may_be_born(http):
    found = {}
    for modes in ({}, {"entering": "off"}, {"uncovered": "off"}, {"entering": "off", "uncovered": "off"}):
        body = {"rig": rig(1000), "settings": {"effects": modes}}
        found[tuple(modes)] = http.post("/v1/estimate", json=body).json()["pictures_mb"]
    without = found.pop(("entering", "uncovered"))
    assert set(found.values()) == {without + NOVEL_PIXEL * 2.0}
    # A frame's pictures, errors and masks by camera, as the cameras' words on it are kept, are in that.
    said = sum(np.dtype(kind).itemsize * times for kind, times in ((np.float32, 3 + 1), (np.bool_, 5)))
    assert said + 2 * np.dtype(np.float64).itemsize <= NOVEL_PIXEL


def test_what_will_not_fit_is_refused_with_what_would(tmp_path):
    running = Running(fake_settings(tmp_path, max_scene_memory_mb=1750))
    try:
        refused = httpx.post(f"{running.url}/v1/scenes", json={"rig": rig(2000)}, timeout=HANG_S)
        document = problem(refused, 422)
        assert document["field"] == "rig.cameras"
        assert "image_scale to 0.5" in document["remedy"]
        assert document["estimate"]["memory_mb"] > 1750
        body = {"rig": rig(2000), "settings": {"scene": {"image_scale": 0.5}}}
        assert httpx.post(f"{running.url}/v1/scenes", json=body, timeout=HANG_S).status_code == 201
    finally:
        running.stop()


@pytest.mark.parametrize("device", ["auto", "gpu"])
def test_a_gpu_without_enough_free_memory_is_not_used(http, device):
    body = {"rig": rig(2000), "settings": {"device": device}}
    needed = http.post("/v1/estimate", json=body).json()["gpu_mb"]
    server, settings, model = ServerSettings(), Settings(device=device), RigModel.model_validate(rig(2000))
    assert fit_gpu(model, settings, server, needed + 1) is fit_gpu(model, settings, server, None) is settings
    if device == "auto":
        assert fit_gpu(model, settings, server, needed - 1) == settings.model_copy(update={"device": "cpu"})
        return
    with pytest.raises(Problem) as refused:
        fit_gpu(model, settings, server, needed - 1)
    document = refused.value.document
    assert f"{needed:.0f} MB of GPU memory" in document.detail
    assert "image_scale to 0.75" in document.remedy
    assert "settings.device to 'cpu'" in document.remedy


def test_a_scene_for_which_the_gpu_has_no_room_is_created_on_the_cpu(http, service, monkeypatch, caplog):
    monkeypatch.setattr("server.routes.scenes.free_gpu_mb", lambda: 100.0)
    created = http.post("/v1/scenes", json={"rig": rig(100), "settings": {"device": "auto"}})
    assert created.status_code == 201, created.text
    id = created.json()["id"]
    assert "device 'auto' selects the CPU" in caplog.text
    assert "100 MB are free" in caplog.text
    assert service.app.state.scenes.awake[id].spec.settings.device == "cpu"
    http.delete(f"/v1/scenes/{id}")
