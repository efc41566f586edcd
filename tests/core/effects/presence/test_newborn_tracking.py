"""What was born in the frame before is looked for from where an attempt starts, wherever that is."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.effects.presence.entering import EFFECT, NAME
from scas4d_core.effects.presence.newborn_tracking import NewbornTracking
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import Tables
from scas4d_core.gaussians import Gaussians
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.frame_update import structure_of
from scas4d_core.update.parts import Attempt, PlanBuilder
from scas4d_core.update.rates import Rates
from scas4d_core.update.view_factory import ViewFactory
from tests.helpers.effect_cases.visited_room import CENTRE, known, scene, seen, visitor

WAY = np.array([-0.05, -0.12, 0.08])


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scas4d_core.effects.presence.newborn_fit.ITERATIONS", 60)


def test_an_attempt_from_where_another_ended_moves_it_no_second_time() -> None:
    before = scene(known())
    result = EFFECT.add_and_retire_gaussians(seen(before, scene(known(), visitor())))
    state, newborn = result.gaussians, np.arange(len(before), len(result.gaussians))
    now = seen(state, scene(known(), visitor(CENTRE + WAY)), 6)
    hierarchy = build_hierarchy(state.means, state.moving, (2, 12), SMALLEST_CLUSTER)
    builder = PlanBuilder(SceneSettings(), UpdateSettings(), ViewFactory(now.rig), hierarchy, state)

    def caught(start: Gaussians) -> np.ndarray:
        """[Y, 3] where the start of an attempt from a state puts the newborn."""
        engine, still = CpuEngine(), Tables.identity(hierarchy)
        engine.bind(builder.plan, structure_of(hierarchy, None, state))
        engine.load_state(start)
        rates, carried = Rates.of(builder.update, len(hierarchy.sizes), now.rig.reach), dict(result.carried)
        attempt = Attempt(engine, now.renderer, start, now.views, rates, still, carried)
        NewbornTracking(builder, NAME).begin(attempt)
        engine.set_tables(attempt.tables)
        return engine.state(learnt=False).means[newborn]

    away = state.means[newborn].mean(axis=0) + WAY
    np.testing.assert_allclose(caught(state).mean(axis=0), away, atol=0.02)
    means = state.means.copy()
    for share in (1.0, 0.5):  # it had been followed, or half of the way
        means[newborn] = state.means[newborn] + np.float32(share * WAY)
        np.testing.assert_allclose(caught(state.replace(means=means)).mean(axis=0), away, atol=0.02)
