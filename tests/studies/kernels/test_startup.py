"""The first minutes of services of two checkouts: measured in turns, told as medians and ratios."""

from __future__ import annotations

from pathlib import Path

import fakes
import pytest

from studies.kernels import startup
from studies.kernels.startup import Start, measure, table

SAMPLE = Path(__file__).parents[3] / "samples" / "robot"


def test_the_table_has_medians_and_ratios_to_the_first() -> None:
    one, two = Path("/one"), Path("/two")
    starts = [
        Start(one, 10, 20, 40, 100), Start(two, 5, 10, 12, 60), Start(one, 10, 20, 40, 100), Start(two, 5, 10, 28, 80),
    ]  # fmt: skip
    lines = table(starts).splitlines()
    assert lines[-2:] == [
        "| one | 10 s | 20 s | 40 s | 100 s | 1.00 | 1.00 |",
        "| two | 5 s | 10 s | 20 s | 70 s | 0.50 | 0.70 |",
    ]
    assert "2 starts each" in lines[0]


def test_checkouts_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = Path("/one"), Path("/two")
    monkeypatch.setattr(startup, "start", lambda capture, checkout: Start(checkout, 1, 2, 3, 4))
    said: list[str] = []
    starts = measure(SAMPLE, [one, two], 2, said.append)
    assert [start.checkout for start in starts] == [one, two, one, two]
    assert said[1].startswith("turn 1, two: ready after 1.0 s")


def test_a_service_is_started_and_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in fakes.environment().items():
        monkeypatch.setenv(name, value)
    found = measure(SAMPLE, [startup.ROOT], 1, print)[0]
    assert 0 < found.ready <= found.first <= found.update
    assert found.processor > 0
