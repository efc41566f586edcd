"""The first update of a scene in several orders of its views: which end is taken, and where there are several."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from box_scene import MOVING, make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.robust import first_motion
from scas4d_core.robust.first_motion import ANOTHER_ORDER, STAGE, best_order
from scas4d_core.robust.solve_frame import FrameSolver
from scas4d_core.settings import Settings, UpdateSettings
from scas4d_core.update.result import UpdateResult, UpdateTrace

RIG, BOX = make_rig(), make_box()
FAR = moved(BOX, Rotation.from_rotvec([0.05, 0.25, 0.0]), np.array([0.08, 0.0, -0.05]))
FURTHER = moved(BOX, Rotation.from_rotvec([0.1, 0.5, 0.0]), np.array([0.16, 0.0, -0.1]))
VIEWS = 3


def ends(*losses: float | Sequence[float]) -> Any:
    """Runs that end with these losses, and the seeds that they were given."""
    seeds: list[int] = []

    def run(seed: int) -> UpdateResult:
        given = losses[len(seeds)]
        seeds.append(seed)
        trace = UpdateTrace(
            [given] * 12 if isinstance(given, float) else list(given), seconds={"start": 2.0, "end": 1.0}
        )
        return UpdateResult(BOX, None, trace)

    return run, seeds


def test_two_orders_that_agree_are_enough_and_the_better_is_taken() -> None:
    run, seeds = ends(0.0101, 0.0100)
    best, orders = best_order(run, 7, VIEWS)
    assert (best.trace.losses[-1], orders) == (0.0100, 2)
    assert seeds == [7, 7 + ANOTHER_ORDER]


@pytest.mark.parametrize("losses", [(0.010, 0.013, 0.0102), (0.013, 0.010, 0.0102), (0.013, 0.0125, 0.010)])
def test_where_two_disagree_a_third_is_tried(losses: tuple[float, ...]) -> None:
    run, seeds = ends(*losses)
    best, orders = best_order(run, 0, VIEWS)
    taken = min(losses) if max(losses[:2]) > (1 + first_motion.AGREE) * min(losses[:2]) else min(losses[:2])
    assert (best.trace.losses[-1], orders, len(set(seeds))) == (taken, 3, 3)


def test_the_last_rounds_decide_and_not_how_it_went() -> None:
    late = [0.5] * 6 + [0.01] * (first_motion.ROUNDS * VIEWS)
    early = [0.01] * 6 + [0.02] * (first_motion.ROUNDS * VIEWS)
    best, _ = best_order(ends(early, late, late)[0], 0, VIEWS)
    assert best.trace.losses == late


def test_an_end_that_is_not_finite_is_never_taken_before_one_that_is() -> None:
    best, orders = best_order(ends(math.nan, 0.02, math.inf)[0], 0, VIEWS)
    assert (best.trace.losses[-1], orders) == (0.02, 3)
    best, _ = best_order(ends(math.nan, math.nan, math.nan)[0], 0, VIEWS)  # what is not finite is refused afterwards
    assert math.isnan(best.trace.losses[-1])


def test_one_that_needed_no_iteration_is_not_tried_again() -> None:
    run, seeds = ends([])
    assert best_order(run, 0, VIEWS)[1] == len(seeds) == 1


def test_seconds_of_the_other_orders_are_told() -> None:
    best, _ = best_order(ends(0.010, 0.013, 0.010)[0], 0, VIEWS)
    assert best.trace.seconds == {"start": 2.0, "end": 1.0, STAGE: 6.0}


def scene(**update: Any) -> Reconstruction:
    settings = Settings(update=UpdateSettings(iterations=15, clusters=(2, 12), **update))
    return Reconstruction.start(RIG, take_frame(0, 0.0, BOX, RIG), settings, static=StaticResult(BOX, {}, []))


def test_only_the_first_update_of_a_scene_is_tried_in_several_orders() -> None:
    one = scene()
    first = one.step(take_frame(1, 0.1, FAR, RIG))
    second = one.step(take_frame(2, 0.2, FURTHER, RIG))
    assert (STAGE in first.seconds, "orders" in first.attempts[0]) == (True, True)
    assert (STAGE in second.seconds, second.attempts) == (False, ["as set"])
    assert np.linalg.norm(one.history.newest.means - FURTHER.means, axis=1)[:MOVING].mean() < 0.02


@pytest.mark.parametrize("update", [{"cold_longer": 1.0}, {"budget_ms": 200.0}])
def test_neither_where_it_may_take_no_longer_nor_by_the_clock(update: dict[str, float]) -> None:
    assert STAGE not in scene(**update).step(take_frame(1, 0.1, FAR, RIG)).seconds


def test_a_lost_order_is_not_what_a_scene_begins_with(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first order is spoilt: the state is that of another one, which shows where things are."""
    spoilt, ran = scene(), list[int]()
    run = FrameSolver._first

    def first(solver: FrameSolver, given: Any, seed: int) -> UpdateResult:
        ran.append(seed)
        result = run(solver, given, seed)
        if len(ran) > 1:
            return result
        worse = replace(result.trace, losses=[2 * loss for loss in result.trace.losses])
        return replace(result, gaussians=BOX, motion=None, trace=worse)

    monkeypatch.setattr(FrameSolver, "_first", first)
    spoilt.step(take_frame(1, 0.1, FAR, RIG))
    assert len(ran) == 3
    assert np.linalg.norm(spoilt.history.newest.means - FAR.means, axis=1)[:MOVING].mean() < 0.02
