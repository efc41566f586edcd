"""Processes that compile kernels side by side, and those who wait for them.

Each process of the pool takes the first kernel that nobody compiles, until none is left. At most one process a core
compiles for one cache at a time, for service, tests and commands alike. Which process compiled a kernel changes
no bit of its results.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable

from scas4d_core.compilation.compiled_markers import CompiledMarkers, open_markers
from scas4d_core.compilation.compiling import compile_kernel
from scas4d_core.compilation.manifest import KernelGroup, kernels_of

log = logging.getLogger("scas4d.kernels")

MAX_PROCESSES = 4
"""Processes of the pool at most: each takes some 350 MB, and the longest kernel takes a sixth of the time of all."""
NICE = 10
"""Added to the niceness of a process that compiles what nobody waits for yet: frames, views and requests go ahead."""
GC_THRESHOLDS = (200_000, 20, 1000)
"""Thresholds of Python's garbage collection: a compiler makes millions of objects that live. With the defaults it
costs a tenth of the time; without any, a process takes half as much memory again."""
POLL_S = 0.05
PARENT_EVERY_S = 0.5
TRIES = 2
"""Pools that are started for the same kernels: the first may have been killed."""

OnProgress = Callable[[int, int], None]
"""Called with the number of kernels that are compiled, and that of all which are waited for."""

_pool: list[subprocess.Popen[bytes]] = []
"""The processes that this one has started."""


def processes() -> int:
    """Returns how many processes compile at a time: one a core."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(cores, MAX_PROCESSES)


def compile_kernels(wanted: Iterable[str], then: Iterable[str]) -> int:
    """Compiles what nobody else does, in a process of the pool; returns how many kernels could not be compiled."""
    _end_with_parent()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)
    marks, failed = open_markers(), 0
    if marks is None:
        return 0
    with marks.slot(processes()) as taken:
        if not taken:
            return 0
        failed += _compile_all(marks, map(KernelGroup, wanted))
        with contextlib.suppress(OSError, AttributeError):
            os.nice(NICE)
        failed += _compile_all(marks, map(KernelGroup, then))
    return failed


def _compile_all(marks: CompiledMarkers, groups: Iterable[KernelGroup]) -> int:
    failed = 0
    for kernel in kernels_of(groups):
        with marks.claim(kernel) as mine:
            if not mine or not marks.missing([kernel]):
                continue
            try:
                compile_kernel(kernel)
            except Exception:
                log.exception("kernel %s.%s could not be compiled", kernel.module, kernel.name)
                failed += 1
            else:
                marks.add(kernel)
    return failed


def wait_for_kernels(
    wanted: Iterable[KernelGroup], then: Iterable[KernelGroup] = (), on_progress: OnProgress | None = None
) -> bool:
    """Waits until the cache has the kernels of the groups ``wanted``, which other processes compile if need be.

    Args:
        then: groups that the same processes go on with, and that nobody waits for here.
        on_progress: called at the beginning where there is something to wait for, and with every kernel.

    Returns:
        False where they could not be compiled beforehand: they are where they are first called.
    """
    wanted, then = tuple(wanted), tuple(then)
    kernels = kernels_of(wanted)
    try:
        marks = open_markers()
    except OSError:
        marks = None
    if marks is None:
        return False
    tries, said = 0, -1
    while True:
        missing = len(marks.missing(kernels))
        if on_progress is not None and (said >= 0 or missing) and said != len(kernels) - missing:
            said = len(kernels) - missing
            on_progress(said, len(kernels))
        later = missing == 0 and tries == 0 and marks.missing(kernels_of(then))
        if missing == 0 and not later:
            return True
        _pool[:] = [process for process in _pool if process.poll() is None]
        if not _pool and not marks.is_compiling(processes()):
            if tries == TRIES:
                log.warning("kernels could not be compiled beforehand; the first frames wait for them")
                return False
            tries += 1
            if not _start(wanted, then):
                tries = TRIES
        if missing == 0:
            return True
        time.sleep(POLL_S)


def _start(wanted: Iterable[KernelGroup], then: Iterable[KernelGroup]) -> bool:
    # The same sources: they may be where only this process looks.
    program = (
        "import sys; groups = [given.split(';') if given else [] for given in sys.argv[1:3]]; "
        "sys.path[:] = sys.argv[3:]; "
        "from scas4d_core.compilation.compile_pool import compile_kernels; sys.exit(compile_kernels(*groups) > 0)"
    )
    command = [sys.executable or "python3", "-c", program, ";".join(wanted), ";".join(then), *sys.path]
    for _ in range(processes()):
        try:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        except OSError:  # no interpreter to be found from inside another program
            return False
        threading.Thread(target=process.wait, daemon=True).start()  # else it would stay a zombie
        _pool.append(process)
    return True


def _end_with_parent() -> None:
    """Ends this process soon after the one that started it."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_EVERY_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
