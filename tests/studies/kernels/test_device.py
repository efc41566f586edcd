"""The comparison of devices: the CPU against the twin stands in for the GPU, and what is wrong is seen."""

from __future__ import annotations

import pytest
import torch
from scas4d_core.engines.torch.device import DeviceError
from typer.testing import CliRunner

from scas4d_core.engines.torch import losses
from studies.commands import app
from studies.kernels import device
from studies.kernels.device import TOLERANCES, Bench, Stage, page


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench("cpu", gaussians=240, size=32, iterations=4)


def test_every_stage_agrees_with_the_twin(bench: Bench) -> None:
    stages = bench.run(repeats=1)
    assert [stage.name for stage in stages] == list(TOLERANCES)
    assert all(stage.agrees for stage in stages), page(stages, "")
    assert all(stage.cpu_ms > 0 and stage.device_ms > 0 for stage in stages)
    lines = page(stages, "heading").splitlines()
    assert lines[0] == "heading"
    assert len(lines) == 4 + len(stages)


def test_the_scene_has_something_to_say(bench: Bench) -> None:
    found = {**bench._cpu_render(), **bench._cpu_losses()}
    assert (found["alpha"] > 0.5).mean() > 0.3
    assert min(found["image"], found["mask"], found["scale"], *found["neighbours"]) > 1e-4
    assert len(bench.hierarchy.sizes) > 1
    assert bench.view.target.shape == (4, 32, 32)


def test_a_wrong_term_is_seen(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    right = losses.isometry_loss
    monkeypatch.setattr(losses, "isometry_loss", lambda *given: 1.01 * right(*given))
    stage = bench._compare("losses", bench._cpu_losses, bench._device_losses, 1)
    assert stage.differences["neighbours"] > TOLERANCES["losses"]
    assert stage.differences["image"] < TOLERANCES["losses"]
    assert not stage.agrees


def test_nan_does_not_agree() -> None:
    stage = Stage("render", {"features": 0.0, "alpha": float("nan")}, 1.0, 1.0, 1.0)
    assert not stage.agrees
    assert "| NO |" in page([stage], "")


def test_without_a_gpu_the_command_says_so_and_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> None:
        raise DeviceError(f"device {name!r}: none", "choose another")

    monkeypatch.setattr(device, "require_device", refuse)
    result = CliRunner().invoke(app, ["device"])
    assert result.exit_code != 0
    assert isinstance(result.exception, DeviceError)  # `main` makes one line of it


def test_the_command_fails_where_a_stage_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "run", lambda **_: ("the table", False))
    result = CliRunner().invoke(app, ["device"])
    assert (result.exit_code, result.stdout.strip()) == (1, "the table")
    monkeypatch.setattr(device, "run", lambda **_: ("the table", True))
    assert CliRunner().invoke(app, ["device"]).exit_code == 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees_with_the_cpu_in_every_stage() -> None:
    pytest.importorskip("gsplat")
    text, agree = device.run(gaussians=2000, size=128, iterations=8, repeats=1)
    assert agree, text
