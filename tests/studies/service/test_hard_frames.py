"""Frame cases pushed through the running service; all of them: `scripts/bench stability --service`."""

from __future__ import annotations

from pathlib import Path

from studies.hard_frames.footage import SyntheticFootage
from studies.service import hard_frames as stability

CASES = ("all black", "swapped", "drop out", "jumps")


def test_cases_through_the_service(tmp_path: Path) -> None:
    lines, faults = stability.study(SyntheticFootage(), tmp_path / "study", CASES, echo=lambda said: None)
    assert faults == []
    assert len(lines) == 8
    assert [(line.case.name, line.size, line.violations) for line in lines if line.violations] == []
    table = stability.table(lines)
    assert "held as it was" in table
    assert "sought" in table


def test_a_footage_turns_round_at_both_ends() -> None:
    footage = SyntheticFootage()
    endless = stability.BackAndForth(footage)
    last = footage.count - 1
    for index, inside in ((0, 0), (last, last), (last + 1, last - 1), (2 * last, 0), (2 * last + 3, 3)):
        assert endless.frame(index).index == inside
