"""The constants of a scene: how near to a camera something is drawn."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.cameras import Camera
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import DEFAULT, NEAR_SHARE, scene_limits
from scas4d_core.engines.views import CameraArrays


@pytest.mark.parametrize(
    ("near", "rig_radius", "metres"),
    [
        ("auto", 4.0, NEAR_SHARE * 4.0),
        ("auto", 0.0, DEFAULT.near),
        ("auto", 0.002, NEAR_SHARE * 0.002),
        (0.2, 4.0, 0.2),
    ],
)
def test_near_is_a_share_of_the_rig_or_what_the_scene_says(near: float | str, rig_radius: float, metres: float) -> None:
    assert scene_limits(near, rig_radius) == DEFAULT._replace(near=metres)


@pytest.mark.parametrize(("near", "drawn"), [(0.3, True), (0.5, False)])
def test_a_gaussian_nearer_than_that_hides_nothing(near: float, drawn: bool) -> None:
    intrinsics = np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
    camera = CameraArrays.of(Camera("c", intrinsics, np.eye(4), 16, 16))
    rasterizer = CpuRasterizer(scene_limits(near, 4.0))
    picture = rasterizer.forward(
        np.array([[0, 0, 0.4]], np.float32), 0.1 * np.eye(3, dtype=np.float32)[None], np.array([0.9], np.float32),
        np.ones((1, 4), np.float32), camera, np.zeros(4, np.float32),
    )  # fmt: skip
    assert (picture.transmittance[8, 8] < 0.2) == drawn
    assert (picture.transmittance == 1).all() != drawn
