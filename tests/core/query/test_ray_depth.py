import numpy as np
import pytest
from ray_cases import CAMERA, gaussians, random_cloud, sheet, stacked

from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import DEFAULT
from scas4d_core.engines.views import CameraArrays
from scas4d_core.query.ray_depth import ray_depths


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.5, 0.2, 1), (0.8, -0.4, 1)])
def test_a_thin_sheet_is_met_where_the_ray_meets_its_plane(normal):
    uv = np.random.default_rng(2).uniform([20, 15], [44, 33], size=(40, 2))
    depth, covered = ray_depths(sheet(normal, 2.0), CAMERA, uv)
    unit = np.asarray(normal) / np.linalg.norm(normal)
    rays = np.concatenate([(uv - [32, 24]) / [120, 110], np.ones((40, 1))], axis=1)
    np.testing.assert_allclose(depth, 2.0 / (rays @ unit), atol=3e-3)
    assert np.all(covered > 0.9)


def test_light_is_lost_as_in_the_rendered_picture():
    cloud = random_cloud()
    picture = CpuRasterizer().forward(
        cloud.means, cloud.factors, cloud.opacities, cloud.colours, CameraArrays.of(CAMERA), np.zeros(3, np.float32)
    )
    rows, columns = np.mgrid[0:48, 0:64]
    uv = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    _, covered = ray_depths(cloud, CAMERA, uv)
    np.testing.assert_allclose(covered.reshape(48, 64), 1 - picture.transmittance, atol=2e-4)


def test_the_depth_lies_on_one_of_two_surfaces_never_between():
    uv = np.array([[32.0, 24.0]])
    back = sheet((0, 0, 1), 3.0, opacity=0.95)
    for opacity, expected in ((0.12, 3.0), (0.7, 1.5)):  # a thin veil, a wall
        one = gaussians([[0, 0, 1.5]], [np.diag([0.3, 0.3, 1e-4])], [opacity])
        np.testing.assert_allclose(ray_depths(stacked(one, back), CAMERA, uv)[0], expected, atol=1e-2)


def test_many_small_shares_of_light_are_lost_halfway():
    layers = [gaussians([[0, 0, z]], [np.diag([0.5, 0.5, 0.05])], [0.05]) for z in np.linspace(1.5, 2.5, 60)]
    depth, covered = ray_depths(stacked(*layers), CAMERA, np.array([[32.0, 24.0]]))
    lost = 1 - 0.95 ** np.arange(1, 61)
    expected = np.linspace(1.5, 2.5, 60)[np.searchsorted(lost, lost[-1] / 2)]
    np.testing.assert_allclose(covered, lost[-1], atol=1e-5)
    np.testing.assert_allclose(depth, expected, atol=0.02)


def test_what_cannot_be_seen_is_not_met():
    behind = gaussians([[0, 0, -2.0], [0, 0, 0.2]], np.tile(0.1 * np.eye(3), (2, 1, 1)), [0.9, 0.9])
    depth, covered = ray_depths(behind, CAMERA, np.array([[32.0, 24.0], [1.0, 1.0]]), DEFAULT._replace(near=0.5))
    assert np.isnan(depth).all()
    assert np.all(covered == 0)
    assert ray_depths(behind, CAMERA, np.empty((0, 2)))[0].shape == (0,)


def test_order_and_company_of_the_rays_do_not_matter():
    cloud = random_cloud()
    uv = np.random.default_rng(3).uniform([0, 0], [64, 48], size=(200, 2))
    together = ray_depths(cloud, CAMERA, uv)[0]
    alone = np.concatenate([ray_depths(cloud, CAMERA, one[None])[0] for one in uv[:20]])
    np.testing.assert_allclose(together[:20], alone, atol=1e-6, equal_nan=True)
    np.testing.assert_allclose(ray_depths(cloud, CAMERA, uv[::-1])[0][::-1], together, atol=1e-6, equal_nan=True)


def test_a_ray_that_grazes_a_wide_flat_one_does_not_meet_it_far_away():
    # The ray runs nearly along the sheet: in the sheet's own metric it is nearest metres away.
    flat = gaussians([[0, 0.01, 2.0]], [np.diag([0.3, 1e-4, 0.3])], [0.9])
    depth, covered = ray_depths(flat, CAMERA, np.array([[32.0, 24.01]]))
    assert covered[0] > 0.3
    assert 1.0 < depth[0] < 3.0
