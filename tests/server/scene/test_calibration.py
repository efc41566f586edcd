"""A rig that frame 0 refined: the service names it, and shows the cameras of the rig as they were refined."""

from __future__ import annotations

import fakes
import numpy as np
import pytest
from running import make_rig, pictures
from sending import create, put_form, serving

SHIFT = 0.25


def pixel_of(sdk, id, camera):
    return sdk.tracks(id, ids=[0], project=[camera]).pixels[camera][0][0]


def test_named_cameras_are_those_refined_and_stay_so(tmp_path):
    """Also for a service that is started again, before its worker has said a word."""
    with serving(tmp_path) as (http, sdk):
        given = create(http, queue_frames=9)
        put_form(http, given, 0, pictures(1))
        sdk.wait(given, 0)
        before = pixel_of(sdk, given, "c1")
        assert sdk.scene(given).warnings == []
        id = create(http, queue_frames=9)
        put_form(http, id, 0, pictures(fakes.REFINES))
        sdk.wait(id, 0)
        put_form(http, id, 1, pictures(2))
        sdk.wait(id, 1)
        after, other = pixel_of(sdk, id, "c1"), pixel_of(sdk, id, "c0")
        camera = make_rig()["c1"]
        assert after[0] - before[0] == pytest.approx(camera.fx * SHIFT / camera.to_camera([0, 0, 0])[2], rel=0.05)
        np.testing.assert_allclose(other, pixel_of(sdk, given, "c0"))
        assert sdk.scene(id).warnings == ["the fake refined c1"]
        report = sdk.frame(id, 0).calibration
        assert report.cameras["c0"].pixels is None
        assert report.refined.cameras["c1"].pose[0][3] == pytest.approx(camera.translation[0] + SHIFT)
        assert sdk.frame(id, 1).calibration is None
    with serving(tmp_path) as (_, sdk):
        assert sdk.scene(id).warnings == ["the fake refined c1"]
        np.testing.assert_allclose(pixel_of(sdk, id, "c1"), after)
