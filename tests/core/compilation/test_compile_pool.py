"""Kernels are compiled side by side, in other processes than the one that computes, and into one cache."""

from __future__ import annotations

import logging
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest

from scas4d_core import warm_up
from scas4d_core.compilation import compile_pool, compiled_markers
from scas4d_core.compilation.compiled_markers import CompiledMarkers
from scas4d_core.compilation.manifest import Kernel, KernelGroup, kernels_of
from scas4d_core.kernels import jit

ONE, TWO, THREE = (Kernel(KernelGroup.UPDATE, "nowhere", name, "f") for name in ("one", "two", "three"))
LATER = Kernel(KernelGroup.STEREO, "nowhere", "later", "f")


@pytest.fixture
def there(tmp_path, monkeypatch):
    """CompiledMarkers in a folder of their own, and kernels that nobody compiles."""
    mine = CompiledMarkers(tmp_path / "compiled_markers")
    found = {KernelGroup.UPDATE: [ONE, TWO, THREE], KernelGroup.STEREO: [LATER]}
    monkeypatch.setattr(compile_pool, "open_markers", lambda: mine)
    monkeypatch.setattr(compile_pool, "kernels_of", lambda groups: [one for group in groups for one in found[group]])
    monkeypatch.setattr(compile_pool, "_end_with_parent", lambda: None)
    monkeypatch.setattr(compile_pool, "_pool", [])
    monkeypatch.setattr(compile_pool.os, "nice", lambda more: None)
    monkeypatch.setattr(compile_pool, "gc", SimpleNamespace(freeze=lambda: None, set_threshold=lambda *given: None))
    return mine


class Started:
    """Stands in for a process of a compile_pool: what `compile_kernels` does, done at once."""

    def __init__(self, command, **_):
        self.groups = [given.split(";") if given else [] for given in command[3:5]]
        assert command[5:] == sys.path  # it finds the same sources
        self.ended = compile_pool.compile_kernels(*self.groups)

    def poll(self):
        return self.ended

    wait = poll


def test_a_crew_compiles_what_the_cache_lacks(there, monkeypatch):
    done, said = [], []
    there.add(TWO)
    monkeypatch.setattr(compile_pool, "compile_kernel", done.append)
    monkeypatch.setattr(subprocess, "Popen", Started)
    assert compile_pool.wait_for_kernels([KernelGroup.UPDATE], on_progress=lambda *given: said.append(given))
    assert done == [ONE, THREE]
    assert said == [(1, 3), (3, 3)]
    assert compile_pool.wait_for_kernels(
        [KernelGroup.UPDATE], on_progress=lambda *given: pytest.fail("there is nothing to wait for")
    )
    assert done == [ONE, THREE]


def test_a_crew_goes_on_with_what_nobody_waits_for(there, monkeypatch):
    done, started = [], []
    monkeypatch.setattr(compile_pool, "compile_kernel", done.append)
    monkeypatch.setattr(subprocess, "Popen", lambda command, **_: started.append(command) or Started(command))
    for kernel in (ONE, TWO, THREE):
        there.add(kernel)
    assert compile_pool.wait_for_kernels([KernelGroup.UPDATE], then=[KernelGroup.STEREO])
    assert started
    assert done == [LATER]


def test_each_kernel_is_compiled_once(there, monkeypatch):
    done = []

    def compile_kernel(kernel):
        time.sleep(0.1)
        done.append(kernel)

    monkeypatch.setattr(compile_pool, "compile_kernel", compile_kernel)
    monkeypatch.setattr(compile_pool, "processes", lambda: 3)
    with ThreadPoolExecutor() as pool:  # flock is of the open file: threads are kept apart as processes are
        assert list(pool.map(lambda _: compile_pool.compile_kernels([KernelGroup.UPDATE], []), range(3))) == [0, 0, 0]
    assert sorted(done, key=lambda kernel: kernel.name) == [ONE, THREE, TWO]


def test_no_more_compile_than_there_are_places(there, monkeypatch):
    monkeypatch.setattr(compiled_markers, "SLOT_WAIT_S", 0.0)
    monkeypatch.setattr(compile_pool, "compile_kernel", lambda kernel: pytest.fail("there is no place"))
    assert not there.is_compiling(1)
    with there.slot(1) as taken:
        assert taken
        assert there.is_compiling(1)
        monkeypatch.setattr(compile_pool, "processes", lambda: 1)
        assert compile_pool.compile_kernels([KernelGroup.UPDATE], []) == 0
    assert not there.is_compiling(1)


def test_who_waits_takes_over_from_a_crew_that_was_killed(there, monkeypatch):
    done, started = [], []

    class Killed(Started):
        def __init__(self, command, **_):
            self.ended = -9

    def popen(command, **_):
        started.append(command)
        return (Killed if len(started) == 1 else Started)(command)

    monkeypatch.setattr(compile_pool, "processes", lambda: 1)
    monkeypatch.setattr(compile_pool, "compile_kernel", done.append)
    monkeypatch.setattr(subprocess, "Popen", popen)
    assert compile_pool.wait_for_kernels([KernelGroup.UPDATE])
    assert done == [ONE, TWO, THREE]


def no_interpreter(command, **_):
    raise FileNotFoundError(command[0])


def cannot(kernel):
    if kernel == TWO:
        raise TypeError("the test says so")


@pytest.mark.parametrize(("popen", "tried"), [(Started, 2), (no_interpreter, 1)])
def test_where_it_fails_the_scene_is_not_kept_from_starting(there, monkeypatch, caplog, popen, tried):
    monkeypatch.setattr(compile_pool, "processes", lambda: 1)
    monkeypatch.setattr(compile_pool, "compile_kernel", cannot)
    monkeypatch.setattr(subprocess, "Popen", popen)
    with caplog.at_level(logging.WARNING):
        assert not compile_pool.wait_for_kernels([KernelGroup.UPDATE])
    assert "could not be compiled in advance" in caplog.text
    assert there.missing([ONE, TWO, THREE]) == ([TWO] if popen is Started else [ONE, TWO, THREE])


def test_a_process_asks_once_for_each_group(monkeypatch):
    asked = []
    monkeypatch.setattr(warm_up, "_settled", set())
    monkeypatch.setattr(warm_up, "wait_for_kernels", lambda wanted, then, told: asked.append(wanted))
    for _ in range(2):
        warm_up.compile_in_processes([KernelGroup.FIRST_FRAME])
    warm_up.compile_in_processes([KernelGroup.FIRST_FRAME, KernelGroup.UPDATE])
    warm_up.compile_in_processes()
    assert asked == [
        (KernelGroup.FIRST_FRAME,),
        (KernelGroup.UPDATE,),
        (KernelGroup.ENTANGLED, KernelGroup.SEPARATE, KernelGroup.STEREO),
    ]


def test_the_marks_are_in_the_cache_of_this_version_and_of_this_checkout(monkeypatch):
    mine = compiled_markers.open_markers()
    assert mine is not None
    assert mine.folder.parent.name.startswith("kernels-")
    monkeypatch.setattr(jit, "__file__", "/elsewhere/scas4d_core/kernels/jit.py")
    other = compiled_markers.open_markers()
    assert other is not None
    other.folder.rmdir()
    assert mine.folder != other.folder
    assert mine.folder.parent == other.folder.parent


def test_without_a_cache_kernels_are_compiled_where_they_are_called(monkeypatch):
    def nowhere():
        raise PermissionError("the test says so")

    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("a process was started"))
    for here in (lambda: None, nowhere):
        monkeypatch.setattr(compile_pool, "open_markers", here)
        assert not compile_pool.wait_for_kernels([KernelGroup.UPDATE])


PROGRAM = """
import sys
from numba.core import event
compiled = []
class Heard(event.Listener):
    def on_start(self, one): compiled.append(one.data["dispatcher"].py_func.__name__)
    def on_end(self, one): pass
event.register("numba:compile", Heard())
from scas4d_core.compilation.compiling import compile_kernel
from scas4d_core.compilation.manifest import KernelGroup, kernels_of
small = [kernel for kernel in kernels_of([KernelGroup.FIRST_FRAME]) if kernel.name in sys.argv[1:]]
for kernel in small: compile_kernel(kernel)
print(len(compiled))
"""


@pytest.mark.slow
def test_a_cache_that_two_processes_fill_serves_a_third(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    root = Path(__file__).parents[3]

    def run(*names):
        command = [sys.executable, "-c", PROGRAM, *names]
        return subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, text=True)

    names = ("tile_offsets", "share_pairs")
    assert len([kernel for kernel in kernels_of([KernelGroup.FIRST_FRAME]) if kernel.name in names]) == 2
    both = [run("tile_offsets"), run("share_pairs")]
    assert [int(process.communicate()[0]) > 0 for process in both] == [True, True]
    third = run(*names)
    assert third.communicate()[0].strip() == "0"
