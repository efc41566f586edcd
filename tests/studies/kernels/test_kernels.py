"""The study of the kernels: pairs counted one by one, arithmetic that is the rasterizer's, and figures that add up."""

import numpy as np
import pytest
from box_scene import make_box, make_rig

from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import DEFAULT
from scas4d_core.engines.views import CameraArrays
from scas4d_core.kernels.blend import BLOCK
from scas4d_core.kernels.projection import CONIC_A, CONIC_B, CONIC_C, DEPTH, MEAN_X, MEAN_Y, OPACITY
from studies.kernels import kernels
from studies.kernels.pairs import GAUSSIANS, PAIRS, SIDE, MicroKernel, blended_pairs


def alphas(splat: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A Gaussian's alpha at pixel centres, float64, 0 outside its support."""
    splat = splat.astype(np.float64)
    dx, dy = x + 0.5 - splat[MEAN_X], y + 0.5 - splat[MEAN_Y]
    form = splat[CONIC_A] * dx * dx + 2 * splat[CONIC_B] * dx * dy + splat[CONIC_C] * dy * dy
    alpha = np.minimum(splat[OPACITY] * np.exp(-form / 2), DEFAULT.alpha_cap)
    return np.where(alpha >= DEFAULT.alpha_floor, alpha, 0)


def test_pairs_are_those_that_the_rasterizer_blends():
    box, rig, rasterizer = make_box(), make_rig(), CpuRasterizer()
    features = np.concatenate([box.colours, box.foreground[:, None]], axis=1)
    for camera in rig.cameras[:2]:
        picture = rasterizer.forward(
            box.means, box.factors, box.opacities, features, CameraArrays.of(camera), np.zeros(4, np.float32)
        )
        pairs, lanes, light = blended_pairs(rasterizer.splats, rasterizer.counts, camera.width, camera.height)
        np.testing.assert_allclose(light, picture.transmittance, atol=1e-6)

        y, x = np.mgrid[: camera.height, : camera.width]
        left, finished, expected = np.ones(x.shape), np.zeros(x.shape, bool), np.zeros(x.shape, int)
        visible = np.flatnonzero(rasterizer.counts > 0)
        for i in visible[np.argsort(rasterizer.splats[visible, DEPTH], kind="stable")]:
            alpha = alphas(rasterizer.splats[i], x, y)
            finished |= (alpha > 0) & (left * (1 - alpha) < DEFAULT.transmittance_stop)
            blended = (alpha > 0) & ~finished
            left = np.where(blended, left * (1 - alpha), left)
            expected += blended
        assert np.abs(pairs - expected).sum() <= 0.001 * expected.sum()  # float32 at the two thresholds
        assert pairs.sum() < lanes


def test_the_micro_kernel_blends_and_carries_back_every_pair():
    micro = MicroKernel(2)
    assert micro.run(3) == 3 * 2 * PAIRS == 3 * 2 * GAUSSIANS * SIDE * SIDE
    y, x = np.mgrid[:SIDE, :SIDE]
    alpha = np.array([alphas(splat, x, y) for splat in micro.splats])
    assert (alpha > 0).all()  # no place in a block is idle
    before = np.cumprod(np.concatenate([np.ones((1, SIDE, SIDE)), 1 - alpha]), axis=0)
    weights = alpha * before[:-1]
    colour = np.einsum("gyx,gc->cyx", weights, micro.features.astype(np.float64))
    assert before[-1].min() > DEFAULT.transmittance_stop
    across = SIDE // BLOCK
    for image in micro.image:  # blocks column by column, pixels of a block row by row
        blocks = image.reshape(across, across, -1, BLOCK, BLOCK)
        planes = blocks.transpose(2, 1, 3, 0, 4).reshape(-1, SIDE, SIDE)
        np.testing.assert_allclose(planes[0], before[-1], rtol=1e-4)
        np.testing.assert_allclose(planes[1:], colour, rtol=1e-4)

    # Backward takes the forward's colours as the incoming gradient and its light as what remains.
    dot = np.einsum("gc,cyx->gyx", micro.features.astype(np.float64), colour)
    behind = before[-1] - np.cumsum(weights * dot, axis=0)
    power_gradient = alpha * (before[:-1] * dot - behind / (1 - alpha))
    dy = np.arange(SIDE)[:, None] + 0.5 - micro.splats[:, MEAN_Y, None, None].astype(np.float64)
    dx = np.arange(SIDE) + 0.5 - micro.splats[:, MEAN_X, None, None].astype(np.float64)
    wanted = [power_gradient * factor for factor in (1, dx, dy, dx * dx, dx * dy, dy * dy)]
    wanted += [weights * plane for plane in colour]
    for sums in micro.sums:
        for column, terms in enumerate(wanted):
            total = terms.sum(axis=(1, 2))
            scale = np.abs(terms).sum(axis=(1, 2)).max()
            np.testing.assert_allclose(sums[:, column].sum(axis=1), total, rtol=2e-3, atol=1e-4 * scale)


def test_the_cloud_has_the_pairs_it_says():
    cloud, camera = kernels.make_cloud()
    rasterizer = CpuRasterizer()
    features = np.concatenate([cloud.colours, cloud.foreground[:, None]], axis=1)
    rasterizer.forward(
        cloud.means, cloud.factors, cloud.opacities, features, CameraArrays.of(camera), np.zeros(4, np.float32)
    )
    pairs, _, _ = blended_pairs(rasterizer.splats, rasterizer.counts, camera.width, camera.height)
    assert pairs.sum() == pytest.approx(2.9e6, rel=0.1)


def test_an_update_is_compared_with_its_own_passes():
    stages = [{"render": 9.0, "render backward": 9.0, "cascade": 9.0}] + [
        {"render": 0.5, "render backward": 0.5, "cascade": share} for share in (0.5, 1.0, 3.0)
    ]
    figures = kernels.update_figures([{"seconds": sum(s.values()) + 0.1, "stages": s} for s in stages])
    assert figures["updates"] == 3  # the first compiles
    assert figures["ratio_update"] == pytest.approx(2.1)
    assert figures["ratio_update_spread"]["min"] == pytest.approx(1.6)
    assert figures["seconds_passes"] == {"min": 1.0, "median": 1.0}
    assert figures["seconds_stages"] == {"render": 0.5, "render backward": 0.5, "cascade": 1.0}


def test_the_page_says_what_was_measured():
    box = make_box()
    on_box = kernels.measure_rasterizer(box, make_rig().cameras[:2], repeats=2)
    ns = on_box["ns_per_pair"]
    assert on_box["gaussians"] == len(box)
    assert 0 < on_box["lanes_filled"] < 1
    assert ns["forward"]["min"] + ns["backward"]["min"] <= ns["rasterizer"]["min"]
    stages = {"render": 0.5, "render backward": 0.5, "cascade": 2.5}
    row = {
        "capture": "robot",
        "measured": "2026-01-02T03:04:05+00:00",
        "core": "0123abcd",
        "machine": {"processor": "A Processor", "cores": 2, "threads": 1},
        "frame_0": on_box | {"ratio": {"min": 1.9, "median": 2.0}},
        "cloud": on_box | {"ratio": {"min": 1.9, "median": 2.01}},
        "iterations": 100,
        "frames": 3,
        "regions": 12.4,
        "ratio_threads": {"min": 0.5, "median": 0.55},
        "peak_mb": 1500.0,
        **kernels.update_figures([{"seconds": 3.5, "stages": stages}] * 3),
    }
    text = kernels.page(row)
    assert "| rasterizer-to-arithmetic ratio, frame 0 | 2.00 | × | ≤ 2 × | reached |" in text
    assert "| rasterizer-to-arithmetic ratio, cloud | 2.01 | × | ≤ 2 × | **missed** |" in text
    assert "| update-to-rasterizer ratio | 3.50 | × | ≤ 3 × | **missed** |" in text
    assert "| parallel regions per iteration | 12.4 |  |  |  |" in text
    assert "| peak memory | 1500 | MB | < 1500 MB | **missed** |" in text
    assert "448<!-- kernels-cost.frame_0_gaussians --> Gaussians, 2 images of 48×48" in text
    assert "\n2026-01-02<!-- kernels-cost.date -->\n(`A Processor, 2 cores, 1 thread used`;" in text
    assert "\n<!-- table: kernels-cost -->\n| | median |" in text
    assert "\n<!-- table: kernels-stages -->\n| cascade |" in text
