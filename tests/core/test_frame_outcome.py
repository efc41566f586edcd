"""Outcomes of frames, and the sentences on them."""

from __future__ import annotations

import json

import pytest

from scas4d_core.frame_outcome import Candidate, FrameOutcome, degraded_text

FAULT = "7 of 300 Gaussians have non-finite values, or moved or grew too much"
UNMET = "the pictures are met at 12.0 dB, 21.0 dB less than usual"


@pytest.mark.parametrize("outcome", FrameOutcome)
def test_an_outcome_is_degraded_or_learnt_as_it_says(outcome: FrameOutcome) -> None:
    assert (degraded_text(outcome, "why") is None) == (not outcome.degraded)
    assert outcome.learnt != (outcome.rejected or outcome is FrameOutcome.UNCHANGED)
    assert json.loads(json.dumps({outcome: [outcome]})) == {outcome.value: [outcome.value]}


def test_the_text_says_first_whether_a_frame_was_held() -> None:
    assert degraded_text(FrameOutcome.REJECTED_MISFIT, UNMET) == f"previous state kept: {UNMET}"
    assert degraded_text(FrameOutcome.RETRIED, f"as set: {FAULT}") == f"as set: {FAULT}"


def test_candidates_are_called_as_they_are_on_disk() -> None:
    assert [candidate.value for candidate in Candidate] == ["end", "previous", "warm"]
