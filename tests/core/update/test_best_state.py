"""Slow motion that small pictures do not show: whole pictures decide where the small ones speak for not moving."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from box_scene import MOVING, make_box

from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import Tables
from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.frame_outcome import Candidate
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.best_state import BestState
from scas4d_core.update.frame_update import structure_of
from scas4d_core.update.warm_start import Motion

BOX = make_box()
HIERARCHY = build_hierarchy(BOX.means, BOX.moving, (2, 6), 4)
WAY = 0.01
"""Metres that all has gone since the frame before, along x."""
NAMES = ("c0", "c1")

Error = Callable[[float], float]
"""The error of a state that is so far, in metres, from where things are."""


def blind(off: float) -> float:
    """In small pictures: what they cannot show weighs more than the motion, and speaks for not moving."""
    return 0.02 - 0.001 * off


def sharp(off: float) -> float:
    return 0.001 + off


class Probes:
    """Errors by how far a state of the engine is off; what was asked for is counted."""

    engine: CpuEngine

    def __init__(self, small: Error, whole: Error, are_whole: bool = False) -> None:
        self.whole, self._small, self._whole = are_whole, small, whole
        self.asked = 0

    def start_errors(self, warm: bool) -> list[dict[str, float]]:
        return [self._found(self._small, moved) for moved in (False, True)[: 1 + warm]]

    def errors(self, *, moved: bool, learnt: bool, state_next: bool = False) -> dict[str, float]:
        return self._found(self._small, moved)

    def full_size_errors(self, *, learnt: bool) -> dict[str, float]:
        self.asked += 1
        return self._found(self._whole, moved=True)

    def _found(self, error: Error, moved: bool) -> dict[str, float]:
        state = self.engine.state(learnt=False) if moved else BOX
        way = np.abs(state.means - BOX.means)[BOX.moving, 0].mean()
        return dict.fromkeys(NAMES, error(abs(float(way) - WAY)))


def ended(probes: Probes, motion: Motion | None = None, at: float = WAY) -> tuple[BestState, CpuEngine]:
    """An update whose first layer ended at a shift along x."""
    engine = probes.engine = CpuEngine()
    engine.bind(UpdatePlan(NAMES), structure_of(HIERARCHY, None, BOX))
    engine.load_state(BOX)
    best = BestState(probes, engine, HIERARCHY, motion, 1.0, 0.0)  # type: ignore[arg-type]
    best.start()
    tables = Tables.identity(HIERARCHY)
    tables.clusters[0][:, 3] = at
    engine.set_tables(tables)
    return best, engine


def means(engine: CpuEngine) -> np.ndarray:
    """[N, 3] metres, where the engine's tables put everything."""
    return engine.state(learnt=False).means


def test_an_end_that_whole_pictures_prefer_is_kept_as_it_was() -> None:
    probes = Probes(blind, sharp)
    best, engine = ended(probes)
    before = means(engine)
    assert best.end(10, {}) is Candidate.END
    assert best.errors[Candidate.PREVIOUS]["c0"] < best.errors[Candidate.END]["c0"]  # the small ones said otherwise
    np.testing.assert_array_equal(means(engine), before)
    np.testing.assert_array_equal(engine.tables().clusters[0][:, 3], np.float32(WAY))


@pytest.mark.parametrize(
    "probes", [Probes(blind, blind), Probes(blind, sharp, are_whole=True), Probes(blind, lambda off: math.nan)]
)
def test_else_what_the_small_pictures_prefer_is_committed(probes: Probes) -> None:
    best, engine = ended(probes)
    assert best.end(10, {}) is Candidate.PREVIOUS
    np.testing.assert_array_equal(means(engine), BOX.means)
    assert probes.asked == (0 if probes.whole else 2)


def test_nothing_is_looked_at_twice_where_the_end_is_the_best() -> None:
    probes = Probes(sharp, sharp)
    best, _ = ended(probes)
    assert (best.end(10, {}), probes.asked) == (Candidate.END, 0)


def test_an_end_that_is_not_finite_is_left() -> None:
    probes = Probes(lambda off: off, sharp)
    best, engine = ended(probes, at=math.nan)
    assert best.end(10, {}) is Candidate.PREVIOUS
    np.testing.assert_array_equal(means(engine), BOX.means)


@pytest.mark.parametrize(
    ("skip_below", "confirmed", "stands"),
    [(0.02, True, True), (0.02, False, False), (0.02, None, True), (0.001, True, False)],
)
def test_a_frame_stands_where_it_is_confirmed(skip_below: float, confirmed: bool | None, stands: bool) -> None:
    asked = []

    def confirm_skip() -> bool:
        asked.append(True)
        return bool(confirmed)

    best, _ = ended(Probes(blind, sharp))
    assert best.can_skip({"c0": skip_below}, None if confirmed is None else confirm_skip) is stands
    assert bool(asked) is (skip_below > 0.01 and confirmed is not None)  # whole pictures are rendered where it matters
    assert not best.can_skip(None, confirm_skip)


def test_the_motion_before_is_taken_where_whole_pictures_prefer_it() -> None:
    """Small pictures prefer not moving to all else, and the end to going on; whole ones say how it is."""
    motion = Motion([np.zeros((2, 3)), np.zeros((6, 3))], [np.full((2, 3), [WAY, 0, 0]), np.zeros((6, 3))],
                    np.zeros((MOVING, 3)), np.zeros((MOVING, 3)), 1.0)  # fmt: skip
    best, engine = ended(Probes(blind, sharp), motion, at=0.6 * WAY)
    assert best.end(10, {}) is Candidate.WARM
    np.testing.assert_allclose(engine.tables().clusters[0][:, 3], WAY, rtol=1e-6)
