"""Each renderer against that of the reference."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from engine_cases import apart, case, gaussians, rig
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.renderer import Neighbourhoods, Renderer, levels, pair_counts
from scas4d_core.engines.torch.renderer import TorchRenderer
from scas4d_core.engines.views import LABEL, CameraArrays
from scas4d_core.gaussians import Gaussians

BACKGROUND, LIMITS = (0.1, 0.2, 0.3), Limits(near=0.2)
TRUE = TorchRenderer(BACKGROUND, LIMITS)
CAMERA = CameraArrays.of(rig().cameras[1])
CAMERAS = [CAMERA, *(CameraArrays.of(rig().cameras[number].scaled(2)) for number in (0, 2))]
SHORT = 8
"""Number of entries of a tile list that is too short for any picture of these tests."""
CLOSE = 1e-4
"""Relative to the norm: float32 against float64."""


@pytest.fixture(params=["cpu", "warp", "warp, short lists"], scope="module")
def tested(request) -> Iterator[Renderer]:  # type: ignore[no-untyped-def]
    if request.param == "cpu":
        yield CpuRenderer(BACKGROUND, limits=LIMITS)
        return
    pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")
    from warp_cases import DEVICE

    from scas4d_core.engines.warp import rasterizer
    from scas4d_core.engines.warp.renderer import WarpRenderer

    class ShortLists(WarpRenderer):
        """Begins every call with tile lists that are too short, so that all work is repeated."""

        repeats = 0

        def _read(self, *given: Any) -> Any:
            if self._rasterizer.holds(1, 1):
                self._rasterizer.capacity = SHORT
                self._rasterizer.resize(self._rasterizer._columns, self._rasterizer._rows)
            read = super()._read(*given)
            self.repeats += self._rasterizer.capacity > SHORT
            return read

    if request.param == "warp":
        yield WarpRenderer(BACKGROUND, LIMITS, DEVICE)
        return
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(rasterizer, "LEAST_CAPACITY", SHORT)
        patched.setattr(rasterizer, "TILES_EACH", 0)
        renderer = ShortLists(BACKGROUND, LIMITS, DEVICE)
        yield renderer
        assert renderer.repeats > 10


@pytest.mark.parametrize("glossy", [False, True])
def test_pictures(tested: Renderer, glossy: bool) -> None:
    state = gaussians(glossy=glossy)
    mine, true = tested.render(state, CAMERA), TRUE.render(state, CAMERA)
    assert mine.features.shape == true.features.shape == (4, 40, 48)
    assert apart(mine.features, true.features) < CLOSE
    assert apart(mine.transmittance, true.transmittance) < CLOSE
    if glossy:
        dull = TRUE.render(state.replace(gloss=None, environment=None), CAMERA)
        assert apart(dull.features, true.features) > 0.01


@pytest.mark.parametrize("at_once", [1, 2**23])
@pytest.mark.parametrize("depth_channel", [-1, LABEL])
def test_pictures_of_several_cameras(
    tested: Renderer, depth_channel: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with suppress(ImportError):
        monkeypatch.setattr("scas4d_core.engines.warp.renderer.PIXELS_AT_ONCE", at_once)
    state = gaussians(glossy=True)
    other = state.replace(means=state.means + np.float32(0.05))
    assert list(tested.render_each([])) == []
    shots = [(each, camera) for camera in CAMERAS for each in (state, other)]
    several = tested.render_each(shots, depth_channel=depth_channel)
    for (each, camera), mine in zip(shots, several, strict=True):
        true = TRUE.render(each, camera, depth_channel=depth_channel)
        assert mine.features.shape == true.features.shape == (4, camera.height, camera.width)
        assert apart(mine.features, true.features) < CLOSE
        assert apart(mine.transmittance, true.transmittance) < CLOSE


@pytest.mark.parametrize("glossy", [False, True])
def test_pictures_in_8_bits_are_the_rounded_ones(tested: Renderer, glossy: bool) -> None:
    state, behind = gaussians(glossy=glossy), np.float32([1.2, -0.3, 0.5, 0])  # some values are clipped
    view = tested.render(state, CAMERA, background=behind)
    colours, opacity = (tested.render_levels(state, CAMERA, behind, opacity=opacity) for opacity in (False, True))
    assert colours.dtype == opacity.dtype == np.uint8
    assert np.array_equal(colours, levels(np.moveaxis(view.features[:LABEL], 0, -1)))
    assert np.array_equal(opacity, levels(1 - view.transmittance))
    assert set(np.unique(colours)) >= {0, 255}
    assert opacity.std() > 10


def test_depth_features_and_another_background(tested: Renderer) -> None:
    state, rng = gaussians(), np.random.default_rng(0)
    given = rng.uniform(size=(len(state), 4)).astype(np.float32)
    behind = np.float32([0.4, 0, 0.9, 7])
    mine, true = (
        renderer.render(state, CAMERA, given.copy(), depth_channel=LABEL, background=behind)
        for renderer in (tested, TRUE)
    )
    assert apart(mine.features, true.features) < CLOSE
    assert true.features[LABEL].max() > 1.5  # metres


def test_eight_features_of_gaussians_that_are_not_all_sound(tested: Renderer) -> None:
    state, rng = gaussians(), np.random.default_rng(0)
    means, given = state.means.copy(), rng.uniform(size=(len(state), 8)).astype(np.float32)
    means[11], given[20, 6], given[30, 1] = np.nan, np.inf, 1e12
    state = state.replace(means=means)
    mine, true = (renderer.render(state, CAMERA, given) for renderer in (tested, TRUE))
    assert mine.features.shape == (8, 40, 48)
    assert apart(mine.features, true.features) < CLOSE
    assert apart(mine.transmittance, true.transmittance) < CLOSE


def test_comparisons(tested: Renderer) -> None:
    scene = case(gaussians())
    assert tested.compare(scene.previous, []) == []
    several = (renderer.compare(scene.previous, scene.views[:3]) for renderer in (tested, TRUE))
    for mine, true in zip(*several, strict=True):
        assert mine.psnr == pytest.approx(true.psnr, abs=1e-3)
        assert mine.image_loss == pytest.approx(true.image_loss, rel=CLOSE)
        assert mine.colour_shift == pytest.approx(true.colour_shift, abs=1e-6)


def test_sums_over_pixels(tested: Renderer) -> None:
    state, rng = gaussians(), np.random.default_rng(3)
    planes = rng.uniform(-1, 1, (3, 40, 48)).astype(np.float32)
    planes[0] = 1
    mine, true = (renderer.gather(state, CAMERA, planes) for renderer in (tested, TRUE))
    assert mine.shape == (len(state), 3)
    assert apart(mine, true) < CLOSE


def test_pairs_per_pixel(tested: Renderer) -> None:
    state = gaussians()
    large = state.replace(factors=2 * state.factors)
    dense = large.replace(opacities=np.full(len(state), 0.95, np.float32))  # finishes pixels early
    for each in (state, large, dense):
        mine, true = (renderer.pairs_per_pixel(each, [CAMERA])[0] for renderer in (tested, TRUE))
        assert mine.dtype == np.int32
        assert np.mean(mine != true) < 0.005  # float32 against float64 at the edges of supports
        assert np.abs(mine - true).max() <= 1
    assert (true < TRUE.pairs_per_pixel(large, [CAMERA])[0]).any()


def test_gaussians_behind_a_finished_pixel_do_not_count_as_pairs(tested: Renderer) -> None:
    row = Gaussians.of_points([[0, 0, 2 + 0.1 * i] for i in range(30)], radius=0.2)
    camera = CameraArrays.of(Camera("front", [[60, 0, 20], [0, 60, 25], [0, 0, 1]], np.eye(4), 40, 50))
    (counted,) = tested.pairs_per_pixel(row, [camera])
    assert counted[25, 20] == 4  # each leaves 0.11, and a fifth would leave less than 1e-4
    faint = row.replace(opacities=np.full(30, 0.01, np.float32))
    (pairs,) = tested.pairs_per_pixel(faint, [camera])
    assert pairs.shape == (50, 40)
    assert pairs[25, 20] == 30
    for each in tested.pairs_per_pixel(faint, [camera, camera], 4):
        np.testing.assert_array_equal(each, pairs[::4, ::4])
    counts = pair_counts(tested, faint, [camera] * 7)
    assert counts.mean == pytest.approx(pairs[::4, ::4].mean())
    assert counts.percentile_99 == np.percentile(pairs[::4, ::4], 99, method="inverted_cdf")


@pytest.mark.parametrize("glossy", [False, True])
def test_a_colour_step_of_some_gaussians(tested: Renderer, glossy: bool) -> None:
    scene = case(gaussians(glossy=glossy))
    before, learnt = scene.previous, (np.arange(len(scene.previous)) % 3 == 0).astype(np.uint8)
    mine, true = (renderer.step_colours(before, [scene.views[1:4]], learnt, 0.05) for renderer in (tested, TRUE))
    steps = [(state.colours - before.colours)[learnt == 1] for state in (mine, true)]
    assert np.abs(steps[1]).max() > 0.01
    assert apart(*steps) < 1e-3  # small differences of pictures
    for state in (mine, true):
        assert np.array_equal(state.colours[learnt == 0], before.colours[learnt == 0])
        assert state.means is before.means
    again, expected = (renderer.step_colours(mine, [scene.views[:2]], learnt, 0.05) for renderer in (tested, TRUE))
    assert apart(again.colours - mine.colours, expected.colours - mine.colours) < 2e-3
    both = tested.step_colours(before, [scene.views[1:4], scene.views[:2]], learnt, 0.05)
    assert apart(both.colours - mine.colours, again.colours - mine.colours) < 1e-5


def test_states_between_and_beyond_frames(tested: Renderer) -> None:
    before = gaussians()
    after = before.replace(means=before.means + np.where(before.moving, np.float32(0.05), np.float32(0))[:, None])
    for share in (0.5, -0.5):
        state = tested.extrapolate(before, after, share)
        np.testing.assert_allclose(state.means, after.means + share * (after.means - before.means), atol=1e-6)
        assert apart(tested.render(state, CAMERA).features, TRUE.render(state, CAMERA).features) < CLOSE


def test_blocks_that_are_reached(tested: Renderer) -> None:
    state = gaussians()
    state = state.replace(foreground=(np.arange(len(state)) < 40).astype(np.float32))
    assert tested.reached(state, []) == []
    several = [renderer.reached(state, CAMERAS) for renderer in (tested, TRUE)]
    for mine, true in zip(*several, strict=True):
        assert mine.shape == true.shape
        assert not (true & ~mine).any()  # a support may pass between the centres of pixels
        assert (mine & ~true).sum() <= 0.2 * mine.sum()
    assert several[0][0].shape != several[0][1].shape


def test_normals_turn_with_their_neighbourhoods(tested: Renderer) -> None:
    before, rng = gaussians(glossy=True), np.random.default_rng(0)
    assert before.gloss is not None
    turn = Rotation.from_rotvec([0.1, 0.5, 0.2]).as_matrix()
    means = (before.means @ turn.T + rng.normal(0, 0.02, before.means.shape)).astype(np.float32)
    means[3] = np.nan
    near = Neighbourhoods(before.means[: len(before.gloss)])
    mine, true = (renderer.turn_normals(before, before.replace(means=means), near) for renderer in (tested, TRUE))
    assert apart(mine.gloss, true.gloss) < CLOSE
    assert apart(true.gloss, before.gloss) > 0.1
    lost = (near.rows == 3).any(axis=1)  # in neighbourhoods of a lost Gaussian
    assert lost.any()
    np.testing.assert_allclose(mine.gloss[lost], before.gloss[lost], atol=1e-6)
