"""When layers begin and rest, and what decides whether they do."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from scas4d_core.frame_outcome import Candidate
from scas4d_core.settings import UpdateSettings
from scas4d_core.update.best_state import BestState
from scas4d_core.update.rates import FIRST_UPDATE_LAYER_ENDS, LAYER_ENDS, NEAR, NEAR_FINEST, NEAR_OWN, Rates


def rates(layers: int = 3) -> Rates:
    return Rates.of(UpdateSettings(), layers, 4.0)


@pytest.mark.parametrize(
    ("layers", "layer_ends"),
    [(0, ()), (1, (1.0,)), (2, (0.75, 1.0)), (3, LAYER_ENDS), (5, (0.5, 0.5, 0.7, 0.75, 1.0))],
)
def test_the_finest_layer_learns_to_the_end_and_those_above_rest_before(
    layers: int, layer_ends: tuple[float, ...]
) -> None:
    assert rates(layers).layer_ends == layer_ends


def test_layers_rest_from_the_coarsest_on_and_the_last_one_never() -> None:
    found = [rates().frozen_layers(iteration, 20) for iteration in range(20)]
    assert found == [0] * 10 + [1] * 5 + [2] * 5
    for iterations in (1, 2, 3, 7):
        counts = [rates().frozen_layers(iteration, iterations) for iteration in range(iterations)]
        assert counts == sorted(counts)
        assert counts[0] == 0
        assert counts[-1] < 3


@pytest.mark.parametrize("iterations", [1, 2, 3, 7, 20, 100])
def test_a_layer_has_a_rate_until_it_rests_and_at_least_once(iterations: int) -> None:
    for layer in range(3):
        times = rates().layer_start(layer), rates().layer_end(layer)
        learns = [rates().factor(iteration, iterations, *times) > 0 for iteration in range(iterations)]
        assert any(learns) or round(times[0] * iterations) >= iterations
        for iteration, one in enumerate(learns):
            assert not (one and rates().frozen_layers(iteration, iterations) > layer)


def test_layers_rest_where_the_motion_before_leads_near_and_nowhere_else() -> None:
    near, far = (rates().for_warm_start(unexplained) for unexplained in (NEAR, NEAR + 0.01))
    assert near.layer_ends == LAYER_ENDS
    assert far.layer_ends == ()
    assert far.frozen_layers(99, 100) == 0
    assert far == replace(rates(), layer_ends=())


@pytest.mark.parametrize("layers", [0, 1])
def test_where_no_layer_rests_nothing_is_faster(layers: int) -> None:
    assert rates(layers).for_warm_start(NEAR) == rates(layers)


@pytest.mark.parametrize("layers", [2, 3])
def test_what_is_below_the_layers_that_rest_learns_faster(layers: int) -> None:
    usual = rates(layers)
    near = usual.for_warm_start(NEAR)
    assert near.layers[:-1] == usual.layers[:-1]
    assert near.layers[-1] == pytest.approx([NEAR_FINEST * rate for rate in usual.layers[-1]])
    assert near == replace(usual, layers=near.layers, position=NEAR_OWN * usual.position)


def test_what_is_not_a_number_leads_nowhere() -> None:
    assert rates().for_warm_start(float("nan")) == replace(rates(), layer_ends=())


def test_without_a_motion_before_layers_are_faster_and_none_rests() -> None:
    cold = rates().for_cold_start(2.0)
    assert cold.layer_ends == ()
    assert rates().for_cold_start(2.0, several_orders=True) == replace(cold, layer_ends=FIRST_UPDATE_LAYER_ENDS)
    assert [turn for turn, _, _ in cold.layers] == [2 * turn for turn, _, _ in rates().layers]


@pytest.mark.parametrize(
    ("previous", "warm", "usual", "share"),
    [
        (0.5, 0.2, 0.1, 0.25),
        (0.5, 0.6, 0.1, 1.25),
        (0.5, 0.05, 0.1, -0.125),
        (0.1, 0.1, 0.1, 1.0),  # nothing changed: nothing tells
        (0.5, None, 0.1, 1.0),
        (0.5, 0.2, None, 1.0),
    ],
)
def test_what_the_motion_before_leaves_is_a_share_of_what_changed(
    previous: float, warm: float | None, usual: float | None, share: float
) -> None:
    probes: Any = SimpleNamespace(whole=False)
    best = BestState(probes, *[None] * 3, 1.0, 0.0)  # type: ignore[arg-type]
    best.errors = {Candidate.PREVIOUS: {"a": previous, "b": previous}}
    if warm is not None:
        best.errors[Candidate.WARM] = {"a": warm, "b": warm}
    known = None if usual is None else {"a": usual, "b": usual, "c": 9.0}
    assert best.unexplained(known) == pytest.approx(share)
    assert best.unexplained({"c": 0.1}) == 1.0
    assert best.unexplained({"a whole": 0.1}) == 1.0  # those of whole pictures are no measure of small ones
