"""What `scas4d doctor` says of a machine."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from client.cli import doctor, extras
from client.cli.main import app
from scas4d_core.engines import choose


@pytest.fixture(autouse=True)
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choose, "gpu_fault", lambda: "no usable NVIDIA GPU was found")


def test_a_machine_that_lacks_nothing_needs_no_remedy(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["doctor", "--data", str(tmp_path / "not" / "yet")])
    assert result.exit_code == 0
    assert "extra server     installed" in result.output
    assert "not used: no usable NVIDIA GPU was found; scenes run on the CPU (see docs/gpu.md)" in result.output
    assert "GB free for" in result.output


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(extras.EXTRAS, "server", ("numpy", "not_there"))
    monkeypatch.setitem(extras.EXTRAS, "gpu", ("not_here",))
    result = CliRunner().invoke(app, ["doctor", "--data", str(tmp_path)])
    assert result.exit_code == 1
    assert "missing: not installed (not_there); run in the project folder: pip install -e '.[server]'" in result.output
    assert "extra gpu        not installed (not_here)" in result.output


@pytest.mark.parametrize(("driver", "old"), [("550.54.14", True), ("580.1.2", False)])
def test_an_old_driver_is_named(driver: str, old: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "version"
    file.write_text(f"NVRM version: NVIDIA UNIX x86_64 Kernel Module  {driver}  Thu Feb 22\n")
    monkeypatch.setattr(doctor, "DRIVER_FILE", file)
    assert (f"NVIDIA Warp requires driver 580, found {driver}" in doctor.gpu().text) == old


def test_little_space_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "LEAST_FREE_GB", 1e9)
    assert "choose another disk with --data" in doctor.disk(tmp_path).text
