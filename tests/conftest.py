"""Tests share scenes: this folder is on the path."""

import os
import sys
from pathlib import Path

import pytest

# Before torch loads OpenMP, which reads it once: threads that spin while they wait cost multiples on busy cores.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session", autouse=True)
def kernels() -> None:
    """Kernels are compiled once, in a process beside: of the tests' processes one asks for it, the others wait."""
    from scas4d_core.warm_up import warm_up_elsewhere

    warm_up_elsewhere()


def pytest_xdist_auto_num_workers() -> int:
    """Processes for ``-n auto``: many tests wait for a service or a clock, so that two share a core."""
    return min(8, 2 * len(os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)))
