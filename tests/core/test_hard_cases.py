"""Every hard case, on every backend that is here, and what the cases notice if a guard is taken away.

The slow cases, and the runs without each guard, take half an hour: `SCAS4D_ALL_HARD_CASES=1 scripts/test -n 0
tests/core/test_hard_cases.py`.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import pytest
from hard_cases import mutate, run
from hard_cases.case import BackendResult, HardCase

from scas4d_core.guards import CONVENTIONS, GUARDS

pytestmark = pytest.mark.slow
ALL = bool(os.environ.get("SCAS4D_ALL_HARD_CASES"))
CASES = [(case, size) for case in run.CASES for size in case.sizes if ALL or not case.slow]


@pytest.mark.parametrize(("case", "size"), CASES, ids=[f"{case.name}-{size}" for case, size in CASES])
def test_holds(case: HardCase, size: object) -> None:
    assert run.violations(case, size, run.backends()) == []


def test_cases_have_names_of_their_own() -> None:
    names = [case.name for case in run.CASES]
    assert len(set(names)) == len(names)


def test_a_case_that_does_not_hold_or_raises_is_seen() -> None:
    class Wrong:
        def run(self, backend: str) -> BackendResult:
            return BackendResult({"value": np.array([np.nan])}, {}, {"folded": 2})

        def violations(self, outcomes: object) -> list[str]:
            return ["it is not so"]

    def breaks(size: object) -> Wrong:
        raise RuntimeError("cannot be made")

    assert run.violations(HardCase("w", "", "", (1,), lambda size: Wrong()), 1, ["cpu"]) == ["it is not so"]
    broken = run.violations(HardCase("b", "", "", (1,), breaks), 1, ["cpu"])
    assert broken == ["raised RuntimeError: cannot be made"]


@pytest.mark.parametrize("guard", list(mutate.mutants()), ids=lambda guard: guard.name)
def test_each_guard_can_be_taken_away(guard: mutate.Guard, tmp_path: Path) -> None:
    """The places that a mutation edits are there once, and a section of the catalogue looks at it."""
    for name in ("guards.py", "engines/cpu/deformation.py", "structure/hierarchy.py", "kernels/projection.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text((mutate.CORE / name).read_text())
    before = {path: path.read_text() for path in tmp_path.rglob("*.py")}
    mutate.take_away(guard, tmp_path)
    assert sum(path.read_text() != text for path, text in before.items()) == 1
    assert mutate.sections_of(guard)


@pytest.mark.skipif(not ALL, reason="takes a minute for each guard; set SCAS4D_ALL_HARD_CASES=1")
@pytest.mark.parametrize("guard", list(mutate.mutants()), ids=lambda guard: guard.name)
def test_a_case_fails_without_each_guard(guard: mutate.Guard) -> None:
    assert mutate.failing_without(guard)


def test_no_clamp_of_the_kernels_has_a_number_of_its_own() -> None:
    """Small and large literals stand in guards.py, or in a polynomial."""
    numbers = re.compile(r"(?<![\w.])\d+(?:\.\d+)?e[-+]?(\d+)")
    others = [
        mutate.CORE / name
        for name in ("engines/torch/deformation.py", "engines/torch/losses.py", "engines/cpu/renderer.py")
    ]
    for path in [*(mutate.CORE / "kernels").glob("*.py"), *others]:
        code = re.sub(r'(?s:""".*?""")|#.*', "", path.read_text())
        tiny = [m.group() for m in numbers.finditer(code) if int(m.group(1)) >= 4 and len(m.group()) < 9]
        # A row outside every tile; when a neighbourhood is flat, and when Jacobi sweeps end. None of them clamps.
        allowed = {"tiles.py": ["1e4"], "turns.py": ["1e-24", "1e-34"]}.get(path.name, [])
        assert tiny == allowed, path.name


def test_names_are_counted_or_part_of_the_method_but_not_both() -> None:
    assert not set(GUARDS) & set(CONVENTIONS)
    assert all(guard.reason and guard.unit and guard.counted for guard in mutate.mutants())
