"""Pool of processes that compile kernels in parallel, and a function that waits for the kernels.

Each process of the pool claims and compiles one kernel after another until no kernel is left. At
most one process per core, and at most ``MAX_PROCESSES``, compile for the same cache at the same
time. The service, tests and commands share this limit. Results are bit-identical regardless of
which process compiled a kernel.
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
from scas4d_core.machine import usable_cores

log = logging.getLogger("scas4d.kernels")

MAX_PROCESSES = 4
"""Maximum number of processes. Each needs about 350 MB, and the slowest kernel takes a sixth of the total time."""
NICE = 10
"""Increase of the niceness of processes that compile in advance. Frames, views and requests thus
take priority."""
GC_THRESHOLDS = (200_000, 20, 1000)
"""Thresholds of Python's garbage collector, tuned for a compiler with millions of long-lived objects.

With the default thresholds, collection takes a tenth of the time; disabling collection increases memory use by half.
"""
POLL_S = 0.05
PARENT_EVERY_S = 0.5
TRIES = 2
"""Maximum number of pools started for the same kernels, because the first one may have been killed."""

OnProgress = Callable[[int, int], None]
"""Callback that receives the number of compiled kernels and the total number to wait for."""

_pool: list[subprocess.Popen[bytes]] = []
"""Pool processes started by this process."""


def processes() -> int:
    """Returns the number of processes that may compile concurrently.

    The number is one per core, but at most ``MAX_PROCESSES``.
    """
    cores = usable_cores()
    return min(cores, MAX_PROCESSES)


def compile_kernels(wanted: Iterable[str], then: Iterable[str]) -> int:
    """Compiles kernels that no other process has claimed.

    This function is the main function of a pool process.

    Args:
        wanted: names of the groups to compile first.
        then: names of the groups to compile afterwards, at low priority.

    Returns:
        Number of kernels that could not be compiled.
    """
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
    """Waits until all kernels of the ``wanted`` groups are cached.

    If kernels are missing, processes that compile these kernels are started.

    Args:
        wanted: groups to wait for.
        then: groups that the same processes compile afterwards. This function does not wait for
            these groups.
        on_progress: function called at the start if kernels are missing, and whenever more kernels
            have been compiled.

    Returns:
        Whether the kernels are cached. If they could not be compiled in advance, each kernel is
        compiled on its first call.
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
                log.warning("kernels could not be compiled in advance; the first frames will take longer")
                return False
            tries += 1
            if not _start(wanted, then):
                tries = TRIES
        if missing == 0:
            return True
        time.sleep(POLL_S)


def _start(wanted: Iterable[KernelGroup], then: Iterable[KernelGroup]) -> bool:
    # The new process gets sys.path, because the package may be importable only with the path of
    # this process.
    program = (
        "import sys; groups = [given.split(';') if given else [] for given in sys.argv[1:3]]; "
        "sys.path[:] = sys.argv[3:]; "
        "from scas4d_core.compilation.compile_pool import compile_kernels; sys.exit(compile_kernels(*groups) > 0)"
    )
    command = [sys.executable or "python3", "-c", program, ";".join(wanted), ";".join(then), *sys.path]
    for _ in range(processes()):
        try:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
        except OSError:  # there is no interpreter, e.g. in an embedded Python
            return False
        threading.Thread(target=process.wait, daemon=True).start()  # avoids zombie processes
        _pool.append(process)
    return True


def _end_with_parent() -> None:
    """Exits this process soon after its parent process ends."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_EVERY_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
