"""The soak compares the last tenth of a run with the first, and reads the memory of a process."""

from __future__ import annotations

import os

import numpy as np
import pytest

from scas4d_core.cameras import Camera, Rig
from studies.live.soak import Row, growth, memory_mb, report

ROWS = [Row(100 * at, 1.0 + at, 100.0, 300.0 + at, 50.0, 200.0 + at, 10.0) for at in range(1, 101)]
RIG = Rig((Camera("a", np.diag([50.0, 50, 1]), np.eye(4), 64, 48),))


def test_growth_is_that_of_the_last_tenth_over_the_first():
    assert growth(ROWS) == pytest.approx((400 + 95.5) / (400 + 5.5))
    assert growth(ROWS, "own") == pytest.approx((250 + 95.5) / (250 + 5.5))


def test_the_table_has_ten_parts():
    text = report(RIG, ROWS)
    assert "| 100 to 1000 | 100.0 | 305.5 | 405.5 | 255.5 |" in text
    assert "| 9100 to 10000 |" in text
    assert "10000 frames" in text


def test_memory_counts_what_a_process_allocates():
    before, own_before = memory_mb(os.getpid())
    block = np.ones(100_000_000, np.uint8)
    after, own_after = memory_mb(os.getpid())
    assert after > own_after
    assert own_after - own_before == pytest.approx(block.nbytes / 1e6, rel=0.2)
    assert after > before
