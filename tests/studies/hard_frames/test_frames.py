"""The frame cases on the made-up footage, all of them; and that a violation is seen."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from studies.hard_frames import frames
from studies.hard_frames.footage import SyntheticFootage
from studies.hard_frames.frames import Footage, FrameCase, Sent
from studies.hard_frames.study import FrameCaseResult, FrameStudy, cases_of, table

FOOTAGE = SyntheticFootage()
CASES = [(case, size) for case in cases_of(FOOTAGE) for size in case.sizes]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> FrameStudy:
    return FrameStudy(FOOTAGE, tmp_path_factory.mktemp("frames") / "study")


@pytest.mark.parametrize(("case", "size"), CASES, ids=[f"{case.name}-{size}" for case, size in CASES])
def test_holds(study: FrameStudy, case: FrameCase, size: Any) -> None:
    line = study.run(case, size)
    assert line is not None
    assert line.violations == []
    assert case.name in table([line])


def test_the_undisturbed_run_follows(study: FrameStudy) -> None:
    assert all(study.undisturbed(index) > 30 for index in range(1, 9))


def unjudged() -> SyntheticFootage:
    """The same footage with the judge off: what the cases are for."""
    settings = FOOTAGE.settings
    return SyntheticFootage(
        settings.model_copy(update={"update": settings.update.model_copy(update={"reject_outliers": False})})
    )


@pytest.mark.parametrize("name", ["all black", "two cameras swapped", "a camera is bumped", "saturated noise"])
def test_without_the_judge_the_cases_do_not_hold(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    bare = FrameStudy(unjudged(), tmp_path_factory.mktemp("bare") / "study")
    case = next(case for case in bare.cases if case.name == name)
    line = bare.run(case, case.sizes[-1])
    assert line is not None
    assert line.violations


def test_what_a_footage_cannot_show_is_left_out(study: FrameStudy) -> None:
    jump = next(case for case in study.cases if case.name == "the object jumps")
    assert study.run(replace(jump, make=lambda footage, at, size: None), 1.0) is None

    def too_long(footage: Footage, at: int, size: Any) -> list[Sent]:
        raise IndexError

    assert study.run(replace(jump, make=too_long), 1.0) is None


def test_the_table_says_what_does_not_hold() -> None:
    line = FrameCaseResult(frames.CASES[0], 3, ["held"], [-1.0, 0.2], ["it is black"])
    assert "**no**: it is black" in table([line])
