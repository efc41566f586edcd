"""Pairs per pixel are counted as they are blended, and frame 0 keeps them few."""

import numpy as np
from box_scene import make_box, make_rig, take_frame

from scas4d_core.cameras import Camera
from scas4d_core.engines.choose import renderer_of
from scas4d_core.engines.limits import DEFAULT, scene_limits
from scas4d_core.engines.views import CameraArrays
from scas4d_core.first_frame import static_scene
from scas4d_core.first_frame.fit_first_frame import fit_static_scene
from scas4d_core.gaussians import Gaussians
from scas4d_core.settings import SceneSettings, StaticSettings
from scas4d_core.update.view_factory import ViewFactory
from studies.rigs.pairs import pairs_per_pixel

CAMERA = CameraArrays.of(Camera("front", [[60, 0, 20], [0, 60, 25], [0, 0, 1]], np.eye(4), 40, 50))


def test_gaussians_behind_a_complete_pixel_do_not_count():
    row = Gaussians.of_points([[0, 0, 2 + 0.1 * i] for i in range(30)], radius=0.2)
    pairs = pairs_per_pixel(row, [CAMERA], DEFAULT).reshape(50, 40)
    assert pairs[25, 20] == 3  # 0.1 × 0.1 × 0.1 is left, and a fourth would fall below the limit
    faint = pairs_per_pixel(row.replace(opacities=np.full(30, 0.01, np.float32)), [CAMERA], DEFAULT)
    assert faint.reshape(50, 40)[25, 20] == 30


def test_pixels_with_pairs_are_those_that_are_drawn():
    rng = np.random.default_rng(0)
    some = Gaussians.of_points(rng.normal([0, 0, 3], 0.3, (40, 3)), radius=0.02)
    light = renderer_of("cpu", (0, 0, 0), DEFAULT).render(some, CAMERA).transmittance
    pairs = pairs_per_pixel(some, [CAMERA, CAMERA], DEFAULT).reshape(2, 50, 40)
    np.testing.assert_array_equal(pairs[0] > 0, light < 1)
    np.testing.assert_array_equal(pairs[0], pairs[1])


def test_the_pressure_on_footprints_keeps_pairs_few_and_costs_no_accuracy(monkeypatch):
    rig, box = make_rig(), make_box()
    factory = ViewFactory(rig)
    cameras = [CameraArrays.of(camera) for camera in rig.cameras[:3]]
    rows = np.random.default_rng(3).permutation(len(box))[:300]
    frame = take_frame(0, 0.0, box, rig)
    settings = StaticSettings(iterations=900, max_gaussians=900, exposure=False)
    monkeypatch.setattr(static_scene, "DENSIFY_EVERY", 50)
    pairs, psnr = [], []
    for shrink in (1.0, static_scene.SHRINK):
        monkeypatch.setattr(static_scene, "SHRINK", shrink)
        views = factory.views(frame, {})[:3]
        found = fit_static_scene(factory, views, box.means[rows], box.colours[rows], None, SceneSettings(), settings)
        limits = scene_limits("auto", rig.radius)
        pairs.append(pairs_per_pixel(found.gaussians, cameras, limits).mean())
        psnr.append(np.mean(found.psnr[-30:]))
    assert pairs[1] < 0.7 * pairs[0]
    assert psnr[1] > psnr[0] - 0.2
