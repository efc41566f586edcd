"""Parallel regions of an iteration, and the time of an update with all threads over its time with one."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
import numpy as np
from numba.np.ufunc import parallel

from client.cli.scores import Row
from client.importers.open_source import open_source
from scas4d_core.captures import Capture
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import StepScalars
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from studies.quality.first_frame import load_first_frame

LAYERS = {"tbb": "tbbpool", "omp": "omppool", "workqueue": "workqueue"}
"""Numba's module of each threading layer."""
ENTRY = "numba_parallel_for"
"""Function that a compiled kernel calls for each parallel region."""


class RegionCounter:
    """Counts the parallel regions that kernels enter in this process.

    Kernels are linked with Numba's entry point when they are compiled or loaded from the cache, so a counter must be
    created before the first kernel is called.

    Attributes:
        count: number of regions entered so far.
    """

    def __init__(self) -> None:
        layers: Any = parallel
        layers._launch_threads()
        layer: Any = import_module(f"numba.np.ufunc.{LAYERS[layers.threading_layer()]}")
        kind = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5, *[ctypes.c_size_t] * 3)
        original = kind(layer.parallel_for)
        self.count = 0

        def enter(*arguments: Any) -> None:
            self.count += 1
            original(*arguments)

        self._entry = kind(enter)  # must not be freed while kernels refer to it
        llvm.add_symbol(ENTRY, ctypes.cast(self._entry, ctypes.c_void_p).value)


class CountingEngine:
    """Counts the parallel regions within ``CpuEngine.iterate``, in all engines of this process.

    Attributes:
        regions: number of regions of each iteration.
    """

    def __init__(self) -> None:
        self.regions: list[int] = []
        counter, iterate = RegionCounter(), CpuEngine.iterate

        def counted(engine: CpuEngine, views: Sequence[int], step: StepScalars) -> None:
            before = counter.count
            iterate(engine, views, step)
            self.regions.append(counter.count - before)

        setattr(CpuEngine, "iterate", counted)  # noqa: B010  # an assignment would not type-check


def count_regions(folder: Path, settings: Settings, frames: int, first_file: Path) -> float:
    """Returns the mean number of parallel regions per iteration of the updates. Call it in a new process.

    Args:
        folder, settings, frames, first_file: see ``compare_threads``.
    """
    engine, capture = CountingEngine(), open_source(folder)
    reconstruction = _start(capture, settings, first_file)
    for index in range(1, frames):
        reconstruction.step(capture.frame(index))
    return float(np.mean(engine.regions))


def compare_threads(folder: Path, settings: Settings, frames: int, first_file: Path) -> Row:
    """Returns the seconds of each update with one thread and with all threads.

    Two reconstructions of the same frames alternate, so both compute the same states.

    Args:
        folder: capture folder.
        settings: settings of frame 0 and the updates.
        frames: number of frames, including frame 0.
        first_file: file in which frame 0 is stored.
    """
    capture, every = open_source(folder), numba.get_num_threads()
    scenes = [(threads, _start(capture, settings, first_file)) for threads in (1, every)]
    seconds: list[list[float]] = [[], []]
    for index in range(1, frames):
        turn = list(zip(seconds, scenes, strict=True))
        for taken, (threads, scene) in turn if index % 2 else reversed(turn):
            numba.set_num_threads(threads)
            started = time.perf_counter()
            scene.step(capture.frame(index))
            taken.append(time.perf_counter() - started)
    return {"one": seconds[0], "all": seconds[1]}


def _start(capture: Capture, settings: Settings, first_file: Path) -> Reconstruction:
    stored = load_first_frame(first_file)
    assert stored is not None  # the study stores it first
    return Reconstruction.start(capture.rig, capture.frame(0), settings, points=capture.points, static=stored[0])
