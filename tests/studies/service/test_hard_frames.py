"""Frame cases pushed through the running service; all of them: `scripts/bench stability --service`."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.hard_frames.footage import SyntheticFootage
from studies.service import hard_frames as stability

CASES = [("all black", 3, "previous state kept"), ("swapped", 2, ""), ("drop out", 2, ""), ("jumps", 1, "search")]
"""Part of the name of a case, its sizes here, and what the table says of it."""


@pytest.mark.parametrize(("case", "sizes", "said"), CASES, ids=[case for case, *_ in CASES])
def test_a_case_through_the_service(tmp_path: Path, case: str, sizes: int, said: str) -> None:
    lines, faults = stability.study(SyntheticFootage(), tmp_path / "study", (case,), echo=lambda words: None)
    assert faults == []
    assert [case in line.case.name for line in lines] == [True] * sizes
    assert [(line.case.name, line.size, line.violations) for line in lines if line.violations] == []
    assert said in stability.table(lines)


def test_a_footage_turns_round_at_both_ends() -> None:
    footage = SyntheticFootage()
    endless = stability.BackAndForth(footage)
    last = footage.count - 1
    for index, inside in ((0, 0), (last, last), (last + 1, last - 1), (2 * last, 0), (2 * last + 3, 3)):
        assert endless.frame(index).index == inside
