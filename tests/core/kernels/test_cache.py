"""Compiled kernels are kept by the digest of their sources."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import scas4d_core
from scas4d_core.kernels import cache

PROGRAM = """
import numpy as np
from caller import outer
print(outer(np.float32(2.0)), sum(outer.stats.cache_hits.values()))
"""
CALLER = """
from scas4d_core.kernels.extra import inner
from scas4d_core.kernels.jit import kernel

@kernel
def outer(x):
    return inner(x) + x
"""
INNER = """
from scas4d_core.kernels.jit import kernel

@kernel
def inner(x):
    return {factor} * x
"""


@pytest.mark.slow
def test_an_edit_in_an_imported_file_is_noticed(tmp_path):
    """What Numba alone gets wrong: `outer` holds the compiled `inner` of another file."""
    source = Path(scas4d_core.__file__).parent
    copy = tmp_path / "scas4d_core"
    (copy / "kernels").mkdir(parents=True)
    for name in ("__init__.py", "guards.py"):
        shutil.copy(source / name, copy)
    for name in ("__init__", "jit", "cache"):
        shutil.copy(source / "kernels" / f"{name}.py", copy / "kernels")
    (tmp_path / "caller.py").write_text(CALLER)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # Python takes an edit in the same second, of the same size, for none

    def run():
        command = [sys.executable, "-c", PROGRAM]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        value, hits = done.stdout.split()
        return float(value), int(hits)

    def edit(factor):
        (copy / "kernels" / "extra.py").write_text(INNER.format(factor=factor))

    edit(10)
    assert run() == (22, 0)
    assert run() == (22, 1)
    edit(20)
    assert run() == (42, 0)
    versions = list((tmp_path / "cache").glob("kernels-*"))
    assert len(versions) == 2
    assert all(list(version.rglob("*.nbc")) for version in versions)


def test_the_digest_is_of_names_and_contents(tmp_path):
    (tmp_path / "a.py").write_text("x")
    first = cache.digest(tmp_path)
    assert cache.digest(tmp_path) == first
    (tmp_path / "notes.txt").write_text("no source")
    assert cache.digest(tmp_path) == first
    (tmp_path / "a.py").write_text("y")
    second = cache.digest(tmp_path)
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    assert len({first, second, cache.digest(tmp_path)}) == 3
    (tmp_path / "below").mkdir()
    (tmp_path / "b.py").rename(tmp_path / "below" / "b.py")
    assert len({first, second, cache.digest(tmp_path)}) == 3


def test_versions_used_last_are_kept(tmp_path):
    for age, name in enumerate(("kernels-new", "kernels-middle", "kernels-old", "else")):
        (tmp_path / name / "inside").mkdir(parents=True)
        os.utime(tmp_path / name, (1e9 - age, 1e9 - age))
    cache.remove_old(tmp_path, kept=2)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["else", "kernels-middle", "kernels-new"]


def test_where_the_cache_is(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert cache.base() == tmp_path
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels-0123"))  # as a process inherits it
    assert cache.base() == tmp_path
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.base() == tmp_path / "scas4d" / "numba"


def test_a_folder_that_cannot_be_made_leaves_numba_its_own(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "as it was")
    (tmp_path / "file").write_text("")
    cache.use(tmp_path / "file")
    assert os.environ["NUMBA_CACHE_DIR"] == "as it was"
