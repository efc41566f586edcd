"""Every hard case that runs fast, on every backend that is here; and the tables that tell of them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from scas4d_core.guards import CONVENTIONS, GUARDS
from studies.hard_cases import mutate, run
from studies.hard_cases.case import BackendResult, HardCase
from studies.options import write_part

FAST = [(case, size) for case in run.CASES for size in case.sizes if not case.slow]


@pytest.mark.parametrize(("case", "size"), FAST, ids=[f"{case.name}-{size}" for case, size in FAST])
def test_holds(case: HardCase, size: object) -> None:
    assert run.run_case(case, size, run.backends()).violations == []


def test_cases_have_names_of_their_own() -> None:
    names = [case.name for case in run.CASES]
    assert len(set(names)) == len(names)


def test_what_does_not_hold_or_raises_is_told() -> None:
    class Wrong:
        def run(self, backend: str) -> BackendResult:
            return BackendResult({"value": np.array([np.nan])}, {}, {"folded": 2})

        def violations(self, outcomes: object) -> list[str]:
            return ["it is not so"]

    def breaks(size: object) -> Wrong:
        raise RuntimeError("cannot be made")

    wrong = run.run_case(HardCase("w", "", "", (1,), lambda size: Wrong()), 1, ["cpu"])
    assert (wrong.violations, wrong.guards) == (["it is not so"], {"folded": 2})
    broken = run.run_case(HardCase("b", "", "", (1,), breaks), 1, ["cpu"])
    assert broken.violations == ["raised RuntimeError: cannot be made"]
    page = run.page([wrong, broken], {"half_turn": ["w"]}, "a machine", "a day")
    assert "2 failures" in page
    assert "1 of 1 removals make a case fail" in page


def test_the_page_keeps_what_stands_beside_its_marks(tmp_path: Path) -> None:
    path = tmp_path / "stability.md"
    path.write_text(f"# Title\n\nbefore\n\n{run.BEGIN}\nold\n{run.END}\n\nafter\n")
    write_part(path, f"{run.BEGIN}\nnew\n{run.END}")
    assert path.read_text() == f"# Title\n\nbefore\n\n{run.BEGIN}\nnew\n{run.END}\n\nafter\n"


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
