"""What a moving thing uncovers: Gaussians that stand are born in the hole, on the surface that goes on through it."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.effects.presence.novelty import novelty_of_views
from scas4d_core.effects.presence.uncovered import EFFECT, NAME
from scas4d_core.effects.presence.uncovered_points import find_uncovered_points
from scas4d_core.effects.switches import IDLE, Switch, decide_switches
from scas4d_core.settings import Settings
from tests.helpers.effect_cases.visited_room import BOX, FLOOR, known, psnr, scene, seen

HOLE = 0.15
ASIDE = BOX + np.array([0.5, 0.0, 0.3])


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scas4d_core.effects.presence.newborn_fit.ITERATIONS", 120)


def test_points_lie_on_the_floor_in_the_hole() -> None:
    frame = seen(scene(known(ASIDE), hole=HOLE), scene(known(ASIDE)))
    found = find_uncovered_points(novelty_of_views(frame, frame.views), frame.result.gaussians, frame.renderer)
    assert len(found.points) > 20
    assert np.abs(found.points[:, 1] - FLOOR).max() < 0.03
    assert np.hypot(*(found.points - BOX)[:, [0, 2]].T).max() < HOLE + 0.03


def test_what_is_born_stands_and_shows_the_floor() -> None:
    before = scene(known(ASIDE), hole=HOLE)
    frame = seen(before, scene(known(ASIDE)))
    evidence = EFFECT.evidence(frame)
    assert evidence is not None
    assert evidence.share > EFFECT.on_above
    result = EFFECT.add_and_retire_gaussians(frame)
    born = result.gaussians.rows(np.arange(len(before), len(result.gaussians)))
    assert len(born) > 20
    assert not born.moving.any()
    assert psnr(result.gaussians, frame) > psnr(before, frame) + 5


def test_nothing_is_born_where_nothing_is_bare() -> None:
    state = scene(known(ASIDE))
    frame = seen(state, state)
    assert EFFECT.add_and_retire_gaussians(frame) is frame.result
    evidence = EFFECT.evidence(frame)
    assert evidence is not None
    assert evidence.share == 0


def test_black_space_is_not_bare() -> None:
    state = known(ASIDE)  # alone, before nothing: the pictures are black where the state has nothing
    frame = seen(state, state)
    assert not any(one.bare.any() for one in novelty_of_views(frame, frame.views))


def test_it_goes_off_where_nothing_more_is_uncovered_and_no_sooner() -> None:
    before, true = scene(known(ASIDE), hole=HOLE), scene(known(ASIDE))
    switches = {NAME: Switch(on=False, since=0)}
    first = seen(before, true)
    switches = decide_switches(switches, Settings(), first)
    assert switches[NAME].on
    born = EFFECT.add_and_retire_gaussians(first)
    on = []
    for index in range(IDLE):
        later = seen(true, true, 6 + index, carried=dict(born.carried))
        switches = decide_switches(switches, Settings(), later)
        on.append(switches[NAME].on)
    assert on == [True] * (IDLE - 1) + [False]
    again = decide_switches(switches, Settings(), seen(before, true, 20, carried=dict(born.carried)))
    assert again[NAME].on


def test_evidence_and_births_look_once(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        "scas4d_core.effects.presence.uncovered.find_uncovered_points",
        lambda *given: asked.append(1) or find_uncovered_points(*given),
    )
    carried = {NAME: {"share": np.array(0.1)}}
    frame = seen(scene(known(ASIDE), hole=HOLE), scene(known(ASIDE)), carried=carried)
    evidence = EFFECT.evidence(frame)
    assert evidence is not None
    assert evidence.share > EFFECT.on_above
    assert len(EFFECT.add_and_retire_gaussians(frame).gaussians) > len(frame.before)
    assert len(asked) == 1
