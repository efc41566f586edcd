"""The comparison of devices on the sample, a little of it."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from scas4d_core.engines.choose import WARP_DEVICE
from studies.devices.devices import compare, table, use_cpu_without_gpu

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"


@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="NVIDIA Warp is not installed")
def test_an_update_of_the_sample_is_that_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(WARP_DEVICE, "cpu")
    assert use_cpu_without_gpu() == "the CPU device of NVIDIA Warp"
    rows = compare(SAMPLE, 0.25, frames=2, iterations=10, static=100)
    assert [row.index for row in rows] == [1, 2]
    assert all(abs(row.difference) < 0.05 for row in rows)
    assert all(row.psnr["cpu"] > 20 for row in rows)
    assert all(0 < row.distance < 2e-4 for row in rows)
    assert "| robot | 2 |" in table(rows)
    apart = compare(SAMPLE, 0.25, frames=2, iterations=10, static=100, apart=True)
    assert apart[1].psnr["cpu"] == rows[1].psnr["cpu"]
    assert apart[1].distance > 2 * rows[1].distance  # the difference of the first update grows
