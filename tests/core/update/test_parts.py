"""Parts of effects: what they change at the start and the end of an attempt is what is committed."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import moved, take_frame
from effect_cases import BEFORE, RIG, UPDATE, builder, updater_of

from scas4d_core.cameras import WorldFrame
from scas4d_core.checkpoint import CarryOver
from scas4d_core.effects.switches import first_switches, register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import UpdateEngine
from scas4d_core.engines.torch.engine import TorchEngine
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import Preparation
from scas4d_core.settings import Settings
from scas4d_core.update.parts import Attempt, PlanBuilder, UpdatePart


class Moves(UpdatePart):
    """Starts the coarsest clusters with a shift, and leaves an array."""

    def begin(self, attempt: Attempt) -> None:
        attempt.tables.clusters[0][:, 3:6] = [0.5, 0, 0]

    def end(self, attempt: Attempt, state: Gaussians) -> Gaussians:
        attempt.carried["moves"] = {"kept": np.array(str(attempt.kept))}
        return state.replace(colours=state.colours + 1)


def one_iteration() -> PlanBuilder:
    names = ["cluster_translation", "rigidity", "moving_colour"]
    return register_effects(builder(update=UPDATE.model_copy(update={"iterations": 1})), names)


@pytest.mark.parametrize("kind", [CpuEngine, TorchEngine])
def test_starts_and_ends_are_called(kind: type[UpdateEngine]) -> None:
    built = one_iteration()
    views = built.factory.views(take_frame(1, 1.0, moved(BEFORE), RIG, True), {})
    without = updater_of(built, kind()).run(BEFORE, views, None, 1.0, seed=3)
    built.parts.append(Moves())
    found = updater_of(built, kind()).run(BEFORE, views, None, 1.0, seed=3)
    went = (found.gaussians.means - without.gaussians.means)[built.hierarchy.rows]
    np.testing.assert_allclose(np.median(went, axis=0), [0.5, 0, 0], atol=0.1)
    assert found.gaussians.colours.min() > 0.9
    assert found.carried["moves"]["kept"] == "end"
    assert without.carried == {}


def test_a_part_that_overrides_nothing_changes_nothing() -> None:
    built = one_iteration()
    views = built.factory.views(take_frame(1, 1.0, moved(BEFORE), RIG, True), {})
    without = updater_of(built).run(BEFORE, views, None, 1.0, seed=3).gaussians.arrays()
    built.parts.append(UpdatePart())
    found = updater_of(built).run(BEFORE, views, None, 1.0, seed=3).gaussians.arrays()
    assert all(np.array_equal(without[name], found[name]) for name in without)


@pytest.mark.parametrize(("rate", "on"), [(0.0, False), (0.01, True)])
def test_a_scene_that_goes_on_with_other_settings_leaves_what_they_refuse(rate: float, on: bool) -> None:
    settings = Settings(update=UPDATE.model_copy(update={"rate_colour": rate}))
    made = Preparation(builder().factory, settings, WorldFrame(np.zeros(3)), CpuRenderer((0, 0, 0)))
    before = first_switches(Settings(effects={"moving_colour": "on", "entering": "on"}), 0)
    prepared = made.rebuild(BEFORE, CarryOver(switches=before))
    switches = prepared.carried.switches
    assert (switches["moving_colour"].on, switches["entering"].on) == (on, True)
    assert (prepared.plan.colours is not None) == on
