"""The fit of the confidence finds the constants with which positions were made, and reports captures left out."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.query.tracks import AGEING, DISAGREEMENT, ODDS, confidence_of
from studies.variants import confidence as study

CONSTANTS = np.array([np.log(ODDS), DISAGREEMENT, AGEING])


def rows(seed: int, bias: float = 0.0) -> np.ndarray:
    """[R, 4] positions that are correct as often as the formula says, or as often as with other odds."""
    rng = np.random.default_rng(seed)
    given = np.column_stack([rng.uniform(0, 1, 4000), rng.exponential(0.01, 4000), rng.integers(1, 24, 4000)])
    probability = study.confidence(given, CONSTANTS + np.array([bias, 0, 0]))
    return np.column_stack([given, rng.random(4000) < probability])


def test_the_study_uses_the_formula_of_the_tracks() -> None:
    given = rows(0)
    mine = study.confidence(given, CONSTANTS)
    for frames in (1, 10, 23):
        own = given[:, 2] == frames
        np.testing.assert_allclose(mine[own], confidence_of(given[own, 0], given[own, 1], frames))


def test_a_fit_finds_the_constants() -> None:
    np.testing.assert_allclose(study.fit([rows(1), rows(2), rows(3)]), CONSTANTS, atol=0.15)


def test_the_report_scores_captures_that_the_fit_has_not_seen() -> None:
    text = study.report({"calm": [rows(1), rows(2)], "usual": [rows(3)], "odd": [rows(4, bias=3.0)]})
    errors = {line.split("|")[1].strip(): float(line.split("|")[2]) for line in text.splitlines()[2:5]}
    assert errors["odd"] > 0.2 > errors["usual"]
    assert "ODDS = " in text
    assert text.splitlines()[-1].startswith("| 0.8 to 1 |")


def test_one_capture_is_not_enough() -> None:
    from typer.testing import CliRunner

    from studies.commands import app

    result = CliRunner().invoke(app, ["confidence", "samples/robot"])
    assert result.exit_code == 2


@pytest.mark.parametrize("covered", [0.0, 1.0])
def test_a_point_without_carriers_has_no_confidence(covered: float) -> None:
    estimate = study.confidence(np.array([[covered, 0.0, 1.0]]), CONSTANTS)
    assert (estimate[0] > 0.9) == bool(covered)
