"""Probe views: small pictures compare states, unless Gaussians smaller than their pixels show in them."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.gaussians import Gaussians
from scas4d_core.update import best_state
from scas4d_core.update.best_state import VIEWS, ProbeViews
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box()


def probes(shown: Gaussians) -> tuple[ProbeViews, list[int]]:
    """Those of a frame in which a state is seen, and the widths at which it is rendered for them."""
    factory, widths = ViewFactory(RIG), list[int]()
    picture = CpuRenderer(factory, (0.0, 0.0, 0.0), 1.0, 0.0)
    measure = picture.measure

    def measured(*given: object) -> None:
        widths.append(given[-1].camera.width)  # type: ignore[attr-defined]
        measure(*given)  # type: ignore[arg-type]

    picture.measure = measured  # type: ignore[method-assign]
    return ProbeViews(factory, picture, factory.views(take_frame(1, 1.0, shown, RIG, False), {})), widths


@pytest.mark.parametrize(("metres", "whole"), [(0.005, True), (0.5, False)])
def test_a_state_that_is_nearly_right_is_compared_in_whole_pictures(
    metres: float, whole: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(best_state, "FEWEST", 0)
    shown = moved(BOX, Rotation.identity(), np.array([metres, 0.0, 0.0]))
    views, widths = probes(shown)
    before = views.errors(BOX)
    assert len(before) == VIEWS
    full = RIG.cameras[0].width
    assert widths == [full // 2, full, *VIEWS * [full if whole else full // 2]]
    widths.clear()
    after = views.errors(shown)  # all candidates are compared in the same pictures
    assert set(widths) == {full if whole else full // 2}
    assert np.mean(list(after.values())) < np.mean(list(before.values()))


def test_small_pictures_are_never_made_smaller() -> None:
    views, widths = probes(moved(BOX, Rotation.identity(), np.array([0.5, 0.0, 0.0])))
    views.errors(BOX)
    assert views.whole
    assert set(widths) == {RIG.cameras[0].width}
