"""Frame cases pushed through the running service; all of them: `scripts/bench stability --service`."""

from __future__ import annotations

from pathlib import Path

from studies.hard_frames.footage import SyntheticFootage
from studies.service import hard_frames as stability

SIZES = {"all black": 3, "jumps": 1}
"""Part of the name of each case, and the number of its sizes: one whose frames are rejected, and one that is followed.
`tests/studies/hard_frames` runs all cases without the service."""


def test_cases_through_the_service(tmp_path: Path) -> None:
    lines, faults = stability.study(SyntheticFootage(), tmp_path / "study", tuple(SIZES), echo=lambda words: None)
    assert faults == []
    assert {case: sum(case in line.case.name for line in lines) for case in SIZES} == SIZES
    assert [(line.case.name, line.size, line.violations) for line in lines if line.violations] == []
    by_case = {case: stability.table([line for line in lines if case in line.case.name]) for case in SIZES}
    assert "previous state kept" in by_case["all black"]
    assert "as set" in by_case["jumps"]


def test_a_footage_turns_round_at_both_ends() -> None:
    footage = SyntheticFootage()
    endless = stability.BackAndForth(footage)
    last = footage.count - 1
    for index, inside in ((0, 0), (last, last), (last + 1, last - 1), (2 * last, 0), (2 * last + 3, 3)):
        assert endless.frame(index).index == inside
