"""Probe views: small pictures compare states, unless Gaussians smaller than their pixels show in them."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import make_box, make_rig, moved, take_frame
from effect_cases import builder
from scipy.spatial.transform import Rotation

from scas4d_core.effects.switches import register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.gaussians import Gaussians
from scas4d_core.update import best_state
from scas4d_core.update.best_state import VIEWS, ProbeViews
from scas4d_core.update.frame_update import structure_of
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box()


def probes(shown: Gaussians) -> tuple[ProbeViews, CpuEngine, list[int]]:
    """Those of a frame in which a state is seen, what compares, and the widths at which it is rendered for them."""
    factory, widths, built = ViewFactory(RIG), list[int](), register_effects(builder())
    engine = CpuEngine()
    engine.bind(built.plan, structure_of(built.hierarchy, None, BOX))
    measure = engine.renderer.forward

    def measured(*given: object) -> None:
        widths.append(given[-1].camera.width)  # type: ignore[attr-defined]
        measure(*given)  # type: ignore[arg-type]

    engine.renderer.forward = measured  # type: ignore[method-assign]
    views = factory.views(take_frame(1, 1.0, shown, RIG, False), {})
    found = ProbeViews(factory, engine, views)
    engine.load_views(views, found.views)
    return found, engine, widths


def errors(views: ProbeViews, engine: CpuEngine, state: Gaussians) -> dict[str, float]:
    engine.load_state(state)
    return views.start_errors(warm=False)[0]


@pytest.mark.parametrize(("metres", "whole"), [(0.005, True), (0.5, False)])
def test_a_state_that_is_nearly_right_is_compared_in_whole_pictures(
    metres: float, whole: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(best_state, "FEWEST", 0)
    shown = moved(BOX, Rotation.identity(), np.array([metres, 0.0, 0.0]))
    views, engine, widths = probes(shown)
    before = errors(views, engine, BOX)
    assert len(before) == VIEWS
    full = RIG.cameras[0].width
    assert widths == [*VIEWS * [full // 2], full, *(VIEWS * [full] if whole else [])]
    widths.clear()
    engine.load_state(shown)
    after = views.errors(moved=False, learnt=False)  # all candidates are compared in the same pictures
    assert set(widths) == {full if whole else full // 2}
    assert np.mean(list(after.values())) < np.mean(list(before.values()))


def test_small_pictures_are_never_made_smaller() -> None:
    views, engine, widths = probes(moved(BOX, Rotation.identity(), np.array([0.5, 0.0, 0.0])))
    errors(views, engine, BOX)
    assert views.whole
    assert set(widths) == {RIG.cameras[0].width}
