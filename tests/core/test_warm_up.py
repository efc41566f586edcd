"""Kernels are compiled in another process than the one that computes."""

from __future__ import annotations

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from scas4d_core import warm_up
from scas4d_core.kernels import jit
from scas4d_core.reconstruction import Reconstruction


@pytest.mark.parametrize("there", [False, True])
def test_another_process_compiles_what_the_cache_lacks(tmp_path, monkeypatch, there):
    mark = tmp_path / "warm"
    if there:
        mark.touch()
    started = []
    monkeypatch.setattr(warm_up, "_settled", False)
    monkeypatch.setattr(warm_up, "marker", lambda: mark)
    monkeypatch.setattr(
        subprocess, "run", lambda program, **_: started.append(program) or SimpleNamespace(returncode=0)
    )
    warm_up.warm_up_elsewhere()
    assert len(started) == (0 if there else 1)
    assert all(program[-len(sys.path) :] == sys.path for program in started)  # it finds the same sources


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
    def no_interpreter(program, **_):
        raise FileNotFoundError(program[0])

    monkeypatch.setattr(warm_up, "marker", lambda: tmp_path / "warm")
    for fails in (lambda program, **_: SimpleNamespace(returncode=1), no_interpreter):
        caplog.clear()
        monkeypatch.setattr(warm_up, "_settled", False)
        monkeypatch.setattr(subprocess, "run", fails)
        warm_up.warm_up_elsewhere()
        assert "could not be compiled" in caplog.text


def test_no_process_asks_twice(tmp_path, monkeypatch):
    started = []
    monkeypatch.setattr(warm_up, "_settled", False)
    monkeypatch.setattr(warm_up, "marker", lambda: tmp_path / "warm")
    monkeypatch.setattr(
        subprocess, "run", lambda program, **_: started.append(program) or SimpleNamespace(returncode=0)
    )
    for _ in range(2):
        warm_up.warm_up_elsewhere()
    assert len(started) == 1


class Reached(Exception):
    """Frame 0 would be fitted now."""


def test_a_process_that_compiles_starts_no_other(monkeypatch, tmp_path):
    monkeypatch.setattr(warm_up, "_settled", False)
    monkeypatch.setattr(warm_up, "marker", lambda: tmp_path / "warm")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("another process was started"))

    def first_scene(*_, **__):
        warm_up.warm_up_elsewhere()
        raise Reached

    monkeypatch.setattr(Reconstruction, "start", first_scene)
    with pytest.raises(Reached):
        warm_up.warm_up()


def test_processes_that_compile_at_a_time_wait_for_the_first(monkeypatch, tmp_path):
    began, ended = [], []

    def compile_them():
        began.append(len(ended))
        time.sleep(0.3)
        ended.append(True)

    monkeypatch.setattr(warm_up, "marker", lambda: tmp_path / "warm")
    monkeypatch.setattr(warm_up, "_reconstruct_a_ball", compile_them)
    with ThreadPoolExecutor() as pool:  # flock is of the open file: threads are kept apart as processes are
        list(pool.map(lambda _: warm_up.warm_up(anew=False), range(3)))
    assert began == [0]
    warm_up.warm_up()  # to load them
    assert began == [0, 1]


def test_without_a_folder_to_write_to_kernels_are_compiled_all_the_same(monkeypatch, tmp_path):
    done = []
    monkeypatch.setattr(warm_up, "marker", lambda: None)
    monkeypatch.setattr(warm_up, "_reconstruct_a_ball", lambda: done.append(True))
    warm_up.warm_up(anew=False)
    assert done == [True]
    with warm_up._alone(tmp_path / "nowhere" / "warm"):
        pass


def test_the_kernels_of_either_covariance_are_compiled(monkeypatch, tmp_path):
    asked = []

    class Scene:
        def step(self, frame):
            pass

        render = tracks_of_pixels = parts = lambda *_: None

    def start(rig, frame, settings, **_):
        asked.append((bool(frame.masks), settings.update.covariance))
        return Scene()

    monkeypatch.setattr(warm_up, "_settled", True)
    monkeypatch.setattr(warm_up, "marker", lambda: tmp_path / "warm")
    monkeypatch.setattr(Reconstruction, "start", start)
    warm_up.warm_up()
    assert {masked for masked, _ in asked} == {True, False}
    assert {covariance for _, covariance in asked} == {"entangled", "separate"}
    assert (tmp_path / "warm").exists()


def test_a_layer_that_rests_is_among_the_kernels_of_either_covariance():
    from scas4d_core.kernels.deform import settle
    from scas4d_core.settings import UpdateSettings

    for covariance in ("entangled", "separate"):
        warm_up._let_a_layer_rest(UpdateSettings(covariance=covariance))
    assert len(settle.signatures) == 2
