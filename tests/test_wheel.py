"""The wheel: the product, all of it, and nothing else."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from source_tree import PACKAGES, ROOT
from waiting import HANG_S

BUILD = "import sys; from setuptools.build_meta import build_wheel; print(build_wheel(sys.argv[1]))"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Built from a copy of the tree, without a network."""
    pytest.importorskip("setuptools")
    copy, out = tmp_path_factory.mktemp("tree") / "scas4d", tmp_path_factory.mktemp("wheel")
    ignored = shutil.ignore_patterns("__pycache__", ".*", "out", "data", "samples", "*.egg-info", "build", "dist")
    shutil.copytree(ROOT, copy, ignore=ignored)
    done = subprocess.run([sys.executable, "-c", BUILD, out], cwd=copy, capture_output=True, text=True, timeout=HANG_S)
    assert done.returncode == 0, done.stderr
    (built,) = out.glob("*.whl")
    return zipfile.ZipFile(built)


def packaged(names: list[str]) -> set[str]:
    """The names outside the folder of metadata."""
    return {name for name in names if not name.partition("/")[0].endswith(".dist-info")}


def test_it_holds_the_product_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    found = packaged(wheel.namelist())
    assert {name.partition("/")[0] for name in found} == set(PACKAGES)
    assert not [name for name in found if {"bench", "stability", "studies", "tests"} & set(Path(name).parts)]
    sources = {path.relative_to(ROOT).as_posix() for package in PACKAGES for path in (ROOT / package).rglob("*.py")}
    pages = [ROOT / "server" / name for name in ("viewer", "reference", "site")]
    shown = {path.relative_to(ROOT).as_posix() for page in pages for path in page.rglob("*") if path.is_file()}
    assert "server/viewer/index.html" in shown
    assert found == sources | {name for name in shown if "__pycache__" not in name}


def test_its_command_is_there(wheel: zipfile.ZipFile) -> None:
    (entry,) = [name for name in wheel.namelist() if name.endswith("entry_points.txt")]
    assert wheel.read(entry).decode().split() == ["[console_scripts]", "scas4d", "=", "client.cli.main:main"]
    assert "client/cli/main.py" in wheel.namelist()
    assert b"def main()" in wheel.read("client/cli/main.py")
