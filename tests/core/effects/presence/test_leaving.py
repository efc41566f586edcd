"""Things that leave: retired once they and what is about them are in no picture, and not before."""

from __future__ import annotations

import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.effects.presence.leaving import EFFECT, FRAMES, outside_all_views
from scas4d_core.gaussians import Gaussians
from tests.helpers.effect_cases.visited_room import known, make_rig, scene, seen, visitor

AWAY = np.array([0.0, -4.0, 0.0])


def test_only_what_moves_and_is_in_no_picture_is_outside() -> None:
    state = scene(known(), visitor(AWAY))
    out = outside_all_views(state, make_rig())
    assert np.flatnonzero(out).tolist() == list(range(len(state) - 300, len(state)))


def test_gaussians_behind_or_beside_all_cameras_are_outside() -> None:
    camera = Camera("a", [[100, 0, 50], [0, 100, 50], [0, 0, 1]], np.eye(4), 100, 100)  # looks along z
    state = Gaussians.of_points([[0, 0, 2], [0, 0, -2], [2, 0, 2], [1.02, 0, 2], [5, 0, 2]], radius=0.02)
    state = state.replace(foreground=np.float32([1, 1, 1, 1, 0]))  # the last one does not move
    assert outside_all_views(state, Rig((camera,))).tolist() == [False, True, True, False, False]


def test_values_that_are_not_finite_affect_no_other_gaussian() -> None:
    camera = Camera("a", [[100, 0, 50], [0, 100, 50], [0, 0, 1]], np.eye(4), 100, 100)
    state = Gaussians.of_points([[np.nan, 0, 2], [np.inf, 0, 2], [0, 0, 2], [0, 0, 2], [2, 0, 2]], radius=0.02)
    factors = state.factors.copy()
    factors[2], factors[3] = np.nan, 1e30
    state = state.replace(factors=factors, foreground=np.ones(5, np.float32))
    found = outside_all_views(state, Rig((camera,)))
    assert found[3:].tolist() == [False, True]


def test_it_is_retired_after_some_frames() -> None:
    state, carried = scene(known(), visitor(AWAY)), {}
    for index in range(FRAMES):
        assert not state.retired.any()
        result = EFFECT.add_and_retire_gaussians(seen(state, scene(known()), index, carried=carried))
        state, carried = result.gaussians, dict(result.carried)
    assert np.flatnonzero(state.retired).tolist() == list(range(len(state) - 300, len(state)))
    evidence = EFFECT.evidence(seen(state, scene(known()), 9, carried=carried))
    assert evidence is not None
    assert evidence.share >= EFFECT.off_below  # as long as it is away: the switch stays


def test_what_came_back_in_time_is_not_retired() -> None:
    away, here = scene(known(), visitor(AWAY)), scene(known(), visitor())
    carried = dict(EFFECT.add_and_retire_gaussians(seen(away, scene(known()), 0)).carried)
    carried = dict(EFFECT.add_and_retire_gaussians(seen(here, here, 1, carried=carried)).carried)
    assert not EFFECT.add_and_retire_gaussians(seen(away, scene(known()), 2, carried=carried)).gaussians.retired.any()


def test_a_thing_that_is_half_in_view_keeps_its_other_half() -> None:
    state = scene(known(), visitor(np.array([0.0, -0.7, 0.0])))
    out = outside_all_views(state, make_rig())
    assert 0 < out.sum() < 300
    carried = {"leaving": {"frames": np.where(out, FRAMES, 0), "share": np.array(0.0)}}
    gone = EFFECT.add_and_retire_gaussians(seen(state, state, 3, carried=carried)).gaussians.retired
    assert gone.sum() < out.sum()


def test_it_is_evidence_how_much_is_outside() -> None:
    inside = EFFECT.evidence(seen(scene(known()), scene(known())))
    out = EFFECT.evidence(seen(scene(known(), visitor(AWAY)), scene(known())))
    assert inside is not None
    assert out is not None
    assert inside.share == 0
    assert out.share == 0.5 > EFFECT.on_above
