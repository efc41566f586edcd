"""The first Gaussians of a cloud, and how many a scene may have."""

from __future__ import annotations

import numpy as np
from box_scene import make_box, make_rig, take_frame

from scas4d_core.fit.initial_gaussians import budget, initial_parameters
from scas4d_core.settings import SceneSettings, StaticSettings
from scas4d_core.update.view_factory import ViewFactory

RIG, BOX = make_rig(), make_box()


def test_detail_is_a_share_of_what_the_rule_gives() -> None:
    views = ViewFactory(RIG).views(take_frame(0, 0.0, BOX, RIG, True), {})
    rule, few, tiny = (budget(views, SceneSettings(), StaticSettings(detail=d)) for d in (1.0, 0.3, 1e-9))
    assert rule > 100
    assert abs(few - 0.3 * rule) < 1
    assert tiny == 1
    given = StaticSettings(max_gaussians=70, detail=0.3)
    assert budget(views, SceneSettings(), given) == 70


def test_first_gaussians_are_as_wide_as_their_neighbours_are_far() -> None:
    line = np.zeros((10, 3))
    line[:, 0] = 0.1 * np.arange(10)
    colours = np.full((10, 3), 0.25, np.float32)
    table = initial_parameters(line, colours, None, 100, np.random.default_rng(0))
    # In the middle the three nearest are at 0.1, 0.1 and 0.2 m.
    np.testing.assert_allclose(np.exp(table[5, 7:10]), np.sqrt((0.01 + 0.01 + 0.04) / 3), rtol=1e-5)
    np.testing.assert_allclose(table[:, 11:14], colours)
    assert len(initial_parameters(line, colours, None, 4, np.random.default_rng(0))) == 4
    alone = initial_parameters(line[:1], colours[:1], np.ones(1, np.float32), 4, np.random.default_rng(0))
    assert np.isfinite(alone).all()
    assert alone[0, 14] > 1
