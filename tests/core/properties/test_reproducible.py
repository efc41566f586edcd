"""The same input, seed and settings give the same bits, whatever the threads and whoever made the processor."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from numpy._core import _multiarray_umath as numpy_core

pytestmark = pytest.mark.slow

PROGRAM = Path(__file__).parents[2] / "helpers" / "committed_bits.py"
LIBRARIES = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def committed(threads: int, changes: Mapping[str, str | None] | None = None) -> dict[str, object]:
    """What a process with so many threads commits; None takes a variable out of its environment."""
    changed = {**os.environ, **dict.fromkeys(LIBRARIES, str(threads)), "PYTHONPATH": str(PROGRAM.parents[2])}
    environment = {name: value for name, value in {**changed, **(changes or {})}.items() if value is not None}
    done = subprocess.run(
        [sys.executable, str(PROGRAM), "0.5"], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, object] = json.loads(done.stdout)
    assert found.pop("threads") == threads
    return found


def another_processor() -> dict[str, str | None]:
    """What makes numpy and BLAS compute as on a processor of 2008: no fused products, narrow registers.

    Where the tests run with kernels for such a one (``NUMBA_CPU_NAME=generic``, as ``.ci/run`` has them run a second
    time), the other processor's kernels are those of this one; else they are the same: compiling takes a minute.
    """
    environment: dict[str, str | None] = {"NUMBA_CPU_NAME": None, "NUMBA_CPU_FEATURES": None}
    if platform.machine() in ("x86_64", "AMD64"):
        environment["OPENBLAS_CORETYPE"] = "Nehalem"
        environment["NPY_DISABLE_CPU_FEATURES"] = " ".join(
            name for name in numpy_core.__cpu_dispatch__ if numpy_core.__cpu_features__[name]
        )
    return environment


def test_one_thread_two_threads_and_another_processor_commit_the_same_bits() -> None:
    one = committed(1)
    assert len(one) == 14
    assert len(set(one.values())) == len(one)  # every state, report and set of parts is another
    assert committed(2) == one
    assert committed(2, another_processor()) == one
