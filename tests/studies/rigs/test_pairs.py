"""Pairs per pixel are counted as they are blended."""

import numpy as np

from scas4d_core.cameras import Camera
from scas4d_core.engines.choose import renderer_of
from scas4d_core.engines.limits import DEFAULT
from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians
from studies.rigs.pairs import pairs_per_pixel

CAMERA = CameraArrays.of(Camera("front", [[60, 0, 20], [0, 60, 25], [0, 0, 1]], np.eye(4), 40, 50))


def test_gaussians_behind_a_complete_pixel_do_not_count():
    row = Gaussians.of_points([[0, 0, 2 + 0.1 * i] for i in range(30)], radius=0.2)
    pairs = pairs_per_pixel(row, [CAMERA], DEFAULT).reshape(50, 40)
    assert pairs[25, 20] == 4  # each leaves 0.11 of the light, and a fifth would fall below 1e-4
    faint = pairs_per_pixel(row.replace(opacities=np.full(30, 0.01, np.float32)), [CAMERA], DEFAULT)
    assert faint.reshape(50, 40)[25, 20] == 30


def test_pixels_with_pairs_are_those_that_are_drawn():
    rng = np.random.default_rng(0)
    some = Gaussians.of_points(rng.normal([0, 0, 3], 0.3, (40, 3)), radius=0.02)
    light = renderer_of("cpu", (0, 0, 0), DEFAULT).render(some, CAMERA).transmittance
    pairs = pairs_per_pixel(some, [CAMERA, CAMERA], DEFAULT).reshape(2, 50, 40)
    np.testing.assert_array_equal(pairs[0] > 0, light < 1)
    np.testing.assert_array_equal(pairs[0], pairs[1])
