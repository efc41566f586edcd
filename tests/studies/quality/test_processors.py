"""The study of processors: its table, and that it goes on where it stopped."""

from __future__ import annotations

import pytest

from studies.machine import core_version
from studies.quality import processors


def made(capture, target, frames, seed, changes):
    """A row as a run would give it: other states on the processor of 2008, where `changes` say so."""
    other = "differ" in changes and "NUMBA_CPU_NAME" in target and target["NUMBA_CPU_NAME"] == "generic"
    return {"psnr": [30.0 + seed, 31.0 + seed], "states": ["a", "x" if other else "b"], "core": core_version()}


@pytest.fixture
def runs(monkeypatch):
    heard = []

    def apart(*given):
        heard.append(given)
        return made(*given)

    monkeypatch.setattr(processors, "_apart", apart)
    return heard


def test_a_study_goes_on_where_it_stopped_and_says_the_spread(tmp_path, runs):
    lines = []
    capture = tmp_path / "ball"
    assert processors.run([capture], tmp_path, frames=2, seeds=3, report=lines.append)
    assert len(runs) == 5  # three targets, two further seeds
    assert "| ball | 30.50 dB | 30.50 dB | 30.50 dB | the same bits | 2.00 dB (1.00 dB, 3 seeds) |" in lines[-1]
    assert (tmp_path / "table.md").read_text() == lines[-1] + "\n"
    processors.run([capture], tmp_path, frames=2, seeds=4, report=lines.append)
    assert len(runs) == 6


def test_other_bits_are_told(tmp_path, runs):
    lines = []
    assert not processors.run(
        [tmp_path / "ball"], tmp_path, frames=2, seeds=1, changes=("differ",), report=lines.append
    )
    assert "| differ | 0.00 dB |" in lines[-1]
