"""Slow motion that small pictures do not show: whole pictures decide where the small ones speak for not moving."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from box_scene import make_box

from scas4d_core.frame_outcome import Candidate
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.best_state import COMMITTED, BestState
from scas4d_core.update.deformation import CpuDeformation, length_bounds
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
    """Errors by how far a state is off; what was asked for is counted."""

    def __init__(self, small: Error, whole: Error, are_whole: bool = False) -> None:
        self.whole, self._small, self._whole = are_whole, small, whole
        self.asked = 0

    def errors(self, state: Gaussians, turns: Any = None) -> dict[str, float]:
        return self._found(self._small, state)

    def whole_errors(self, state: Gaussians, turns: Any = None) -> dict[str, float]:
        self.asked += 1
        return self._found(self._whole, state)

    def _found(self, error: Error, state: Gaussians) -> dict[str, float]:
        moved = np.abs(state.means - BOX.means)[BOX.moving, 0].mean()
        return dict.fromkeys(NAMES, error(abs(float(moved) - WAY)))


def ended(probes: Probes, motion: Motion | None = None, at: float = WAY) -> tuple[BestState, CpuDeformation]:
    """An update whose first layer ended at a shift along x, with its second at rest."""
    deformation = CpuDeformation(HIERARCHY, None, length_bounds(HIERARCHY, BOX), "centred")
    deformation.start(BOX)
    best = BestState(probes, deformation, BOX, motion, 1.0, 0.0)  # type: ignore[arg-type]
    best.start()
    for values in (*deformation.clusters, deformation.deltas):
        values[:] = 0
    deformation.clusters[0][:, 3] = at
    deformation.rest(1)
    deformation.forward()
    return best, deformation


def test_an_end_that_whole_pictures_prefer_is_kept_as_it_was() -> None:
    probes = Probes(blind, sharp)
    best, deformation = ended(probes)
    means = deformation.means.copy()
    assert best.end(BOX, 10, {}) is Candidate.END
    assert best.errors[Candidate.STILL]["c0"] < best.errors[Candidate.END]["c0"]  # the small ones said otherwise
    np.testing.assert_array_equal(deformation.means, means)
    np.testing.assert_array_equal(deformation.clusters[0][:, 3], np.float32(WAY))


@pytest.mark.parametrize(
    "probes", [Probes(blind, blind), Probes(blind, sharp, are_whole=True), Probes(blind, lambda off: math.nan)]
)
def test_else_what_the_small_pictures_prefer_is_committed(probes: Probes) -> None:
    best, deformation = ended(probes)
    assert best.end(BOX, 10, {}) is Candidate.STILL
    np.testing.assert_array_equal(deformation.means, BOX.means)
    assert probes.asked == (0 if probes.whole else 2)


def test_nothing_is_looked_at_twice_where_the_end_is_the_best() -> None:
    probes = Probes(sharp, sharp)
    best, _ = ended(probes)
    assert (best.end(BOX, 10, {}), probes.asked) == (Candidate.END, 0)


def test_an_end_that_is_not_finite_is_left() -> None:
    probes = Probes(lambda off: off, sharp)
    best, deformation = ended(probes, at=math.nan)
    assert best.end(BOX, 10, {}) is Candidate.STILL
    np.testing.assert_array_equal(deformation.means, BOX.means)


ENOUGH = {"c0": 0.02, "c1": 0.02}


@pytest.mark.parametrize(
    ("enough", "stands"),
    [
        (ENOUGH, False),  # nothing is known of whole pictures
        (ENOUGH | {"c0" + COMMITTED: 0.002}, False),  # they show that it moved
        (ENOUGH | {"c0" + COMMITTED: 0.02}, True),
        ({"c0" + COMMITTED: 0.02}, False),
        ({"c0": 0.001, "c0" + COMMITTED: 0.02}, False),
    ],
)
def test_a_frame_stands_where_whole_pictures_agree(enough: Mapping[str, float], stands: bool) -> None:
    best, _ = ended(Probes(blind, sharp))
    assert best.stands(enough) is stands


def test_what_was_committed_is_the_measure_of_the_next_frame() -> None:
    best, _ = ended(Probes(blind, sharp))
    assert best.committed(BOX) == {name + COMMITTED: pytest.approx(0.001 + WAY) for name in NAMES}
