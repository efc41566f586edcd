"""The frame cases: faulty frames are sent, and the result is compared with an undisturbed run.

They run on synthetic footage, or on a capture: `SCAS4D_FRAME_CASES=CAPTURE scripts/test -n 0
tests/core/robust/test_frame_cases.py`.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from frame_cases.cases import Footage, FrameCase, Sent
from frame_cases.footage import CapturedFootage, SyntheticFootage
from frame_cases.study import FrameStudy, cases_of

from studies.captures import open_measured
from studies.quality.settings import settings_of

pytestmark = pytest.mark.slow
CAPTURE = os.environ.get("SCAS4D_FRAME_CASES")
FOOTAGE = (
    CapturedFootage(open_measured(Path(CAPTURE)), settings_of("scas4d"), Path("out/quality"))
    if CAPTURE
    else SyntheticFootage()
)
CASES = [(case, size) for case in cases_of(FOOTAGE) for size in case.sizes]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> FrameStudy:
    return FrameStudy(FOOTAGE, tmp_path_factory.mktemp("frames") / "study")


@pytest.mark.parametrize(("case", "size"), CASES, ids=[f"{case.name}-{size}" for case, size in CASES])
def test_holds(study: FrameStudy, case: FrameCase, size: Any) -> None:
    found = study.run(case, size)
    if CAPTURE and found is None:
        pytest.skip("the capture cannot show this case")
    assert found == []


def test_the_undisturbed_run_follows(study: FrameStudy) -> None:
    assert all(study.undisturbed(index) > 30 for index in range(1, 9))


def unjudged() -> SyntheticFootage:
    """The same footage with the judge off: what the cases are for."""
    settings = SyntheticFootage().settings
    return SyntheticFootage(
        settings.model_copy(update={"update": settings.update.model_copy(update={"reject_outliers": False})})
    )


@pytest.mark.parametrize("name", ["all black", "two cameras swapped", "a camera is bumped", "saturated noise"])
def test_without_the_judge_the_cases_do_not_hold(name: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    bare = FrameStudy(unjudged(), tmp_path_factory.mktemp("bare") / "study")
    case = next(case for case in bare.cases if case.name == name)
    assert bare.run(case, case.sizes[-1])


def test_what_a_footage_cannot_show_is_left_out(study: FrameStudy) -> None:
    jump = next(case for case in study.cases if case.name == "the object jumps")
    assert study.run(replace(jump, make=lambda footage, at, size: None), 1.0) is None

    def too_long(footage: Footage, at: int, size: Any) -> list[Sent]:
        raise IndexError

    assert study.run(replace(jump, make=too_long), 1.0) is None
