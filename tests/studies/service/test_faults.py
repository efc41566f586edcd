"""The fault table, reduced: the whole of it is `scripts/bench faults`."""

from __future__ import annotations

import random
from pathlib import Path

import fakes
import pytest

from scas4d_core.captures import open_capture
from studies.running import study as of
from studies.service import faults

ROOT = Path(__file__).parents[3]
CAPTURE = ROOT / "samples" / "robot"
SHORT = {
    "scene": {"image_scale": 0.125},
    "static": {"iterations": 60, "max_gaussians": 600},
    "update": {"iterations": 6},
}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    capture = open_capture(CAPTURE)
    fake = fakes.environment(FAKE_UPDATE_S="0.1")
    frames = of.encoded_frames(capture, 8)
    return of.Study(tmp_path_factory.mktemp("faults"), capture, frames, {}, fake)


@pytest.fixture(scope="module")
def expected(study):
    return of.undisturbed(study)


def test_states_of_the_fake_depend_on_every_frame(expected):
    assert len(set(expected[0].values())) == 8


def test_kills(study, expected):
    outcome = faults.kills(study, *expected, count=4, seed=1, echo=lambda said: None)
    assert outcome.faults == []


def test_kills_with_the_method_itself(tmp_path):
    capture = open_capture(CAPTURE)
    study = of.Study(tmp_path, capture, of.encoded_frames(capture, 4), SHORT, {})
    expected, seconds = of.undisturbed(study)
    assert faults.kills(study, expected, seconds, count=2, seed=3, echo=lambda said: None).faults == []


def test_a_lost_frame_and_another_state_are_noticed():
    assert of.compare({0: "a", 1: "b"}, {0: "a", 1: "c", 2: "d"}) == [
        "frames [2] are not committed",
        "states [1] are not bit-identical: got b, expected c",
    ]


def test_half_of_the_kills_are_between_stages():
    planned = faults.planned_kills(16, 40, random.Random(0))
    kills = [kill for at in planned.values() for kill in at]
    staged = [kill for kill in kills if kill.stage is not None]
    assert (len(kills), len(staged)) == (40, 20)
    assert set(staged) == {faults.Kill(victim, stage) for victim in faults.VICTIMS for stage in faults.STAGES}
    assert all(kill.stage is None for kill in planned.get(0, ()))  # frame 0 takes minutes
