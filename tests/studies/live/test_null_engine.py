"""The null engine keeps everything but the update: a still scene stays as it is, and its frames are committed."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import make_box, make_rig, take_frame

from scas4d_core import preparation, reconstruction
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.frame import InitialPoints
from scas4d_core.settings import Settings
from studies.live import null_engine
from studies.live.live import LiveResult, report

SETTINGS = {
    "static": {"iterations": 30, "max_gaussians": 400},
    "update": {"iterations": 10, "clusters": [2, 12, 48], "skip_tolerance": -1},
}


@pytest.fixture
def installed(monkeypatch):
    for module, name in ((preparation, "engine_of"), (reconstruction, "renderer_of")):
        monkeypatch.setattr(module, name, getattr(module, name))  # restored afterwards
    null_engine.install()


def test_a_still_scene_stays_as_it_is_without_a_rendering(installed):
    box, rig = make_box(), make_rig()
    points = InitialPoints(box.means.astype(np.float64), box.colours, box.foreground)
    scene = reconstruction.Reconstruction.start(
        rig, take_frame(0, 0.0, box, rig), Settings.model_validate(SETTINGS), points=points
    )
    before = scene.history.newest
    for index in (1, 2):
        outcome = scene.step(take_frame(index, index / 30, box, rig))
        assert not outcome.outcome.rejected
        assert outcome.iterations > 0
    after = scene.history.newest
    np.testing.assert_array_equal(after.means, before.means)
    np.testing.assert_array_equal(after.colours, before.colours)


def test_the_report_names_the_rate_and_the_latency():
    camera = Camera("a", np.diag([50.0, 50, 1]), np.eye(4), 64, 48)
    text = report(Rig((camera,)), LiveResult(12.34, [10.0, 20.0, 30.0], {"decode": 4.4}))
    assert "1 cameras of 64×48" in text
    assert "| 12.3 |" in text
    assert "20 / 29 ms" in text
    assert "decode 4" in text
