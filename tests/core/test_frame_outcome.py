"""Outcomes of frames, and how they are read from the reports of earlier versions, which have the text alone."""

from __future__ import annotations

import json
from typing import Any

import pytest

from scas4d_core.frame_outcome import Candidate, FrameOutcome, degraded_text, outcome_of

FAULT = "7 of 300 Gaussians are not finite, or moved or grew too far"
UNMET = "the pictures are met at 12.0 dB, 21.0 dB less than usual"
BEFORE: list[tuple[dict[str, Any], FrameOutcome | None]] = [
    ({"degraded": None, "iterations": 100}, FrameOutcome.UPDATED),
    ({"degraded": None, "iterations": 0}, FrameOutcome.STOOD),
    ({}, None),
    ({"outcome": "of a later version"}, None),
    ({"degraded": f"as set: {FAULT}"}, FrameOutcome.RETRIED),
    ({"degraded": f"{UNMET}; sought 0.30 m away"}, FrameOutcome.RELOCATED),
    ({"degraded": f"{UNMET}, for 10 frames: taken as it is from here on"}, FrameOutcome.ACCEPTED),
    (
        {"degraded": "held as it was: the pictures are 0.001 times as bright as they were", "iterations": 0},
        FrameOutcome.HELD_UNUSABLE,
    ),
    ({"degraded": f"held as it was: {FAULT}"}, FrameOutcome.HELD_IMPLAUSIBLE),
    ({"degraded": f"held as it was: {UNMET}"}, FrameOutcome.HELD_UNMET),
    ({"degraded": f"held as it was: in 1.4 times the light {UNMET}"}, FrameOutcome.HELD_UNMET),
]


@pytest.mark.parametrize(("record", "outcome"), BEFORE)
def test_reports_of_before_have_their_outcome_in_the_text(record: dict[str, Any], outcome: FrameOutcome) -> None:
    assert outcome_of(record) is outcome


@pytest.mark.parametrize("outcome", FrameOutcome)
def test_reports_of_today_name_it(outcome: FrameOutcome) -> None:
    assert outcome_of({"outcome": outcome.value, "degraded": "held as it was: anything"}) is outcome
    assert (degraded_text(outcome, "why") is None) == (not outcome.degraded)
    assert outcome.learnt != (outcome.held or outcome is FrameOutcome.STOOD)
    assert json.loads(json.dumps({outcome: [outcome]})) == {outcome.value: [outcome.value]}


def test_the_text_says_first_whether_a_frame_was_held() -> None:
    assert degraded_text(FrameOutcome.HELD_UNMET, UNMET) == f"held as it was: {UNMET}"
    assert degraded_text(FrameOutcome.RETRIED, f"as set: {FAULT}") == f"as set: {FAULT}"


def test_candidates_are_called_as_they_are_on_disk() -> None:
    assert [candidate.value for candidate in Candidate] == ["end", "still", "warm"]
