"""Frame cases pushed through the running service; all of them: `scripts/bench stability --service`."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.hard_frames.footage import SyntheticFootage
from studies.service import hard_frames as stability

CASES = {"all black": 3, "swapped": 2, "drop out": 2, "jumps": 1}
"""Part of the name of a case, and its sizes here."""


@pytest.mark.parametrize(("case", "sizes"), CASES.items(), ids=list(CASES))
def test_a_case_through_the_service(tmp_path: Path, case: str, sizes: int) -> None:
    lines, faults = stability.study(SyntheticFootage(), tmp_path / "study", (case,), echo=lambda said: None)
    assert faults == []
    assert [case in line.case.name for line in lines] == [True] * sizes
    assert [(line.case.name, line.size, line.violations) for line in lines if line.violations] == []
    if case == "all black":
        assert "held as it was" in stability.table(lines)


def test_a_footage_turns_round_at_both_ends() -> None:
    footage = SyntheticFootage()
    endless = stability.BackAndForth(footage)
    last = footage.count - 1
    for index, inside in ((0, 0), (last, last), (last + 1, last - 1), (2 * last, 0), (2 * last + 3, 3)):
        assert endless.frame(index).index == inside
