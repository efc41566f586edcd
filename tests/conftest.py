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
    """No test computes with kernels that its own process compiled: their last bits, and its memory, are others."""
    from scas4d_core.warm_up import warm_up_elsewhere

    warm_up_elsewhere()
