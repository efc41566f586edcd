"""Kernels are compiled in another process than the one that computes."""

from __future__ import annotations

import subprocess
from types import SimpleNamespace

import pytest

from scas4d_core import warm_up
from scas4d_core.kernels import jit


@pytest.mark.parametrize("there", [False, True])
def test_another_process_compiles_what_the_cache_lacks(tmp_path, monkeypatch, there):
    mark = tmp_path / "warm"
    if there:
        mark.touch()
    started = []
    monkeypatch.setattr(warm_up, "marker", lambda: mark)
    monkeypatch.setattr(
        subprocess, "run", lambda program, **_: started.append(program) or SimpleNamespace(returncode=0)
    )
    warm_up.warm_up_elsewhere()
    assert len(started) == (0 if there else 1)


def test_the_mark_is_in_the_cache_of_this_version():
    mark = warm_up.marker()
    assert mark is not None
    assert mark.parent.name.startswith("kernels-")
    assert mark.name.startswith("warm-")


def test_a_checkout_elsewhere_has_a_mark_of_its_own(monkeypatch):
    here = warm_up.marker()
    monkeypatch.setattr(jit, "__file__", "/elsewhere/scas4d_core/kernels/jit.py")
    there = warm_up.marker()
    assert here != there
    assert here.parent == there.parent


def test_where_it_fails_the_scene_is_not_kept_from_starting(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(warm_up, "marker", lambda: tmp_path / "warm")
    monkeypatch.setattr(subprocess, "run", lambda program, **_: SimpleNamespace(returncode=1))
    warm_up.warm_up_elsewhere()
    assert "could not be compiled" in caplog.text
