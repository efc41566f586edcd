"""Only the pixels that moving Gaussians reach are drawn: the state has the bits that it has from whole pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from box_scene import make_box, make_rig, moved, take_frame
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig
from scas4d_core.effects.switches import register_effects
from scas4d_core.engines.cpu import changed_pixels
from scas4d_core.engines.cpu import engine as cpu_engine
from scas4d_core.engines.cpu.blocks import as_blocks, as_grid
from scas4d_core.engines.cpu.changed_pixels import ChangedPixels, take_rows
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.cpu.renderer import CpuRenderer, blocks_of
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels import image_loss
from scas4d_core.preparation import SMALLEST_CLUSTER
from scas4d_core.settings import SceneSettings, UpdateSettings
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update.frame_update import FrameUpdate
from scas4d_core.update.parts import PlanBuilder
from scas4d_core.update.result import AttemptOptions, UpdateResult
from scas4d_core.update.view_factory import ViewFactory

RIG = make_rig()
BOX = make_box()
SETTINGS = UpdateSettings(clusters=(2, 12), iterations=12)
MOVES = 40
"""The Gaussians that move; the rest of the box stands."""


def few_move() -> Gaussians:
    """The box, of which a corner moves; the Gaussians are small, so that they reach few blocks."""
    label = np.zeros(len(BOX), np.float32)
    label[np.argsort(np.linalg.norm(BOX.means - BOX.means.min(axis=0), axis=1))[:MOVES]] = 1
    return BOX.replace(foreground=label, factors=0.4 * BOX.factors)


def displaced(state: Gaussians, shift: float) -> Gaussians:
    turned = moved(state, Rotation.from_rotvec([0, 0.2, 0]), np.array([shift, 0, 0]))
    means = np.where(state.moving[:, None], turned.means, state.means)
    return state.replace(means=means.astype(np.float32))


def updater(state: Gaussians, most: float, monkeypatch: pytest.MonkeyPatch) -> tuple[FrameUpdate, ViewFactory]:
    monkeypatch.setattr(cpu_engine, "MOST", most)
    factory = ViewFactory(RIG)
    hierarchy = build_hierarchy(state.means, state.moving, SETTINGS.clusters, SMALLEST_CLUSTER)
    neighbours = Neighbours(state.means[hierarchy.rows], 6, 200.0)
    built = register_effects(PlanBuilder(SceneSettings(), SETTINGS, factory, hierarchy, state))
    return FrameUpdate(CpuEngine(), built, neighbours), factory


def frames(state: Gaussians, most: float, monkeypatch: pytest.MonkeyPatch, masks: bool) -> list[UpdateResult]:
    """Three frames, the last of them a jump out of what was drawn so far."""
    made, factory = updater(state, most, monkeypatch)
    assert isinstance(made._engine.renderer, ChangedPixels) == (most > 0)
    results: list[UpdateResult] = []
    for index, shift in enumerate((0.02, 0.04, 0.3), 1):
        views = factory.views(take_frame(index, float(index), displaced(state, shift), RIG, masks), {})
        before = results[-1] if results else UpdateResult(state, None, None)  # type: ignore[arg-type]
        options = AttemptOptions(compare=True)
        results.append(made.run(before.gaussians, views, before.motion, 1.0, index, options))
    return results


@pytest.mark.parametrize("masks", [True, False])
def test_the_state_has_the_same_bits(monkeypatch: pytest.MonkeyPatch, masks: bool) -> None:
    state = few_move()
    for part, whole in zip(
        frames(state, 0.6, monkeypatch, masks), frames(state, -1.0, monkeypatch, masks), strict=True
    ):
        for name, array in whole.gaussians.arrays().items():
            np.testing.assert_array_equal(part.gaussians.arrays()[name], array, err_msg=name)
        assert (part.gaussians.means != state.means)[state.moving].any()
        assert (part.gaussians.means == state.means)[~state.moving].all()
        np.testing.assert_allclose(part.trace.losses, whole.trace.losses, rtol=1e-4)
        np.testing.assert_allclose(part.trace.psnr, whole.trace.psnr, atol=1e-3)
        for candidate, found in whole.trace.errors.items():
            np.testing.assert_allclose(
                list(part.trace.errors[candidate].values()), list(found.values()), rtol=1e-4, err_msg=candidate
            )
        for name, fit in whole.trace.cameras.items():
            np.testing.assert_allclose(part.trace.cameras[name]["colour_shift"], fit["colour_shift"], atol=1e-5)
        assert part.trace.shown.keys() == whole.trace.shown.keys() != set()
        for name, shown in whole.trace.shown.items():
            np.testing.assert_array_equal(part.trace.shown[name].planes, shown.planes, err_msg=name)


def test_what_stands_is_rendered_anew_once_it_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    state = few_move()
    darker = state.replace(colours=np.where(state.moving[:, None], state.colours, 0.5 * state.colours))
    made, factory = updater(state, 0.6, monkeypatch)
    views = factory.views(take_frame(1, 1.0, displaced(state, 0.02), RIG), {})
    made.run(state, views, None, 1.0, 1)
    after = made.run(darker, views, None, 1.0, 1)
    fresh, factory = updater(state, 0.6, monkeypatch)
    wanted = fresh.run(darker, factory.views(take_frame(1, 1.0, displaced(state, 0.02), RIG), {}), None, 1.0, 1)
    np.testing.assert_array_equal(after.gaussians.means, wanted.gaussians.means)
    np.testing.assert_allclose(after.trace.psnr, wanted.trace.psnr)


def test_a_camera_that_is_posed_otherwise_is_rendered_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    state = few_move()
    frame = take_frame(1, 1.0, displaced(state, 0.02), RIG)
    turned = Rig(tuple(_turned(camera) if camera.name == "c1" else camera for camera in RIG.cameras))
    made, factory = updater(state, 0.6, monkeypatch)
    before = made.run(state, factory.views(frame, {}), None, 1.0, 1)
    factory.posed = turned
    after = made.run(state, factory.views(frame, {}), None, 1.0, 1)
    fresh, factory = updater(state, 0.6, monkeypatch)
    factory.posed = turned
    wanted = fresh.run(state, factory.views(frame, {}), None, 1.0, 1)
    np.testing.assert_array_equal(after.gaussians.means, wanted.gaussians.means)
    np.testing.assert_allclose(after.trace.psnr, wanted.trace.psnr)
    assert after.trace.fits["c1"] < before.trace.fits["c1"] - 3  # its picture is of the camera as it was


def _turned(camera: Camera) -> Camera:
    pose = camera.world_to_camera.copy()
    pose[:3] = Rotation.from_rotvec([0, 0.05, 0]).as_matrix() @ pose[:3]
    return replace(camera, world_to_camera=pose)


def test_less_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few entries of the tile lists, and fewer Gaussians: that is what the time goes by."""
    monkeypatch.setattr(changed_pixels, "MARGIN", 0)  # the pictures have twelve blocks a side
    state = few_move()
    drawn = []
    forward = CpuRasterizer.forward

    def counted(self: CpuRasterizer, means: np.ndarray, *args: object, **more: object) -> object:
        picture = forward(self, means, *args, **more)  # type: ignore[arg-type]
        drawn.append((len(means), int(self._last.starts[-1])))
        return picture

    monkeypatch.setattr(CpuRasterizer, "forward", counted)
    found = {}
    for most in (0.6, -1.0):
        made, factory = updater(state, most, monkeypatch)
        drawn.clear()
        made.run(state, factory.views(take_frame(1, 1.0, displaced(state, 0.02), RIG), {}), None, 1.0, 1)
        found[most] = np.median(drawn, axis=0)
    assert (found[0.6] < 0.8 * found[-1.0]).all()


def test_a_view_in_which_nothing_moves_has_no_gradient() -> None:
    state = few_move().replace(foreground=np.zeros(len(BOX), np.float32))
    factory = ViewFactory(RIG)
    picture = ChangedPixels((0.0, 0.0, 0.0), 1.0, 0.1, np.zeros(0, np.int64), len(BOX))
    whole = CpuRenderer((0.0, 0.0, 0.0), 1.0, 0.1)
    picture.load_state(state)
    features = np.concatenate([state.colours, state.foreground[:, None]], axis=1)
    given = (state.means, state.factors, state.opacities, features)
    view = factory.views(take_frame(0, 0.0, BOX, RIG), {})[0]
    assert not any(array.any() for array in picture.forward_backward(*given, view))
    whole.forward_backward(*given, view)
    assert picture.psnr == pytest.approx(whole.psnr)
    assert picture.image_part == pytest.approx(whole.image_part)


def test_blocks_and_their_grid_are_the_same() -> None:
    camera = ViewFactory(RIG).views(take_frame(0, 0.0, BOX, RIG), {})[0].camera
    state = (BOX.means, BOX.factors, BOX.opacities, np.zeros((len(BOX), 4), np.float32))
    blocks = blocks_of(CpuRasterizer(), *take_rows(state, np.arange(MOVES)), camera)
    grid = as_grid(blocks, camera)
    np.testing.assert_array_equal(as_blocks(grid, camera), blocks)
    alone = [array[:MOVES] for array in (BOX.means, BOX.factors, BOX.opacities)]
    white = np.ones((MOVES, 4), np.float32)
    picture = CpuRasterizer().forward(*alone, white, camera, np.zeros(4, np.float32))
    seen = np.repeat(np.repeat(grid, 4, 0), 4, 1)[: camera.height, : camera.width]
    assert picture.features[0].max() > 0.1
    assert not picture.features[0][~seen].any()


@pytest.mark.parametrize("seed", range(40))
def test_losses_of_the_box_and_around_it_are_those_of_the_whole_picture(seed: int) -> None:
    """Of pictures of any size, whose width is no multiple of sixteen, with what changes anywhere."""
    rng = np.random.default_rng(seed)
    height, width = (int(size) for size in rng.integers((6, 6), (60, 100)))
    shown = np.zeros((height, width), bool)
    for _ in range(rng.integers(1, 4)):
        row, column = rng.integers(0, (height, width))
        shown[row : row + 6, column : column + 9] = True
    before, target = rng.uniform(size=(2, 3, height, width)).astype(np.float32)
    after = np.where(shown, rng.uniform(size=before.shape).astype(np.float32), before)
    means, squares = np.empty_like(target), np.empty_like(target)
    image_loss.target_moments(target, scratch_of(height, width), means, squares)

    def found(image: np.ndarray, box: tuple[slice, slice], wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        image, truth, mean, square = (np.ascontiguousarray(array[:, *box]) for array in (image, target, means, squares))
        rows, gradient = np.empty((3, image.shape[1], 2), np.float32), np.full_like(image, np.nan)
        exposure = np.tile(np.array([1.1, 0], np.float32), (3, 1))
        image_loss.image_loss(
            1, image, exposure, truth, mean, square, np.ones(3, np.float32), height * width,
            scratch_of(*image.shape[1:]), wanted, gradient, rows, np.empty_like(rows),
        )  # fmt: skip
        return rows.sum(axis=(0, 1), dtype=np.float64), gradient

    all_of, box = (slice(height), slice(width)), changed_pixels._box(shown)
    near = image_loss.near(shown[box])
    rest, _ = found(before, all_of, changed_pixels._outside_region(box, near, height, width))
    changed, gradient = found(after, box, near)
    whole, wanted = found(after, all_of, image_loss.EVERYWHERE)
    np.testing.assert_allclose(rest + changed, whole, rtol=1e-5)
    np.testing.assert_array_equal(gradient[:, shown[box]], wanted[:, shown])


def scratch_of(height: int, width: int) -> np.ndarray:
    """Scratch of the image loss for a picture, with what another one left in it."""
    scratch = np.zeros((6, 3, height + 2 * image_loss.REACH, image_loss.stride(width)), np.float32)
    scratch[:, :, image_loss.REACH : -image_loss.REACH] = np.nan
    return scratch
