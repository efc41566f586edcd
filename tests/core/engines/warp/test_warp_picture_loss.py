"""The picture loss in Warp, on its CPU device, against the reference in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

import warp as wp
from engine_cases import apart
from warp_cases import DEVICE, camera, index, view_of

from scas4d_core.engines.torch import losses
from scas4d_core.engines.torch.parameters import leaf
from scas4d_core.engines.views import TrainingView
from scas4d_core.engines.warp.layout import COLUMNS, IMAGE_LOSS, MASK_LOSS, SHIFT, SQUARES, TILE
from scas4d_core.engines.warp.picture_loss import PictureLoss
from scas4d_core.engines.warp.rasterizer import Rasterizer

CLOSE = 1e-4
SIZES = [(48, 32), (37, 29), (16, 16), (5, 3), (13, 70)]
IMAGE, MASK = 2.0, 3.0


def shot(width: int, height: int, seed: int = 0, mask: bool = True) -> tuple[TrainingView, np.ndarray]:
    """A view, and a rendering of it; both with black parts."""
    rng = np.random.default_rng(seed)
    smooth = np.cumsum(rng.uniform(-0.2, 0.2, (4, height, width)), axis=2).clip(0, 1)
    view = view_of(smooth, camera(width, height), seed, mask)
    picture = (smooth + rng.normal(0, 0.05, smooth.shape)).astype(np.float32)
    picture[:, : height // 2, : width // 2] = view.target[:, : height // 2, : width // 2] = 0
    return view, picture


def covered(picture: np.ndarray) -> np.ndarray:
    """[H, W] the pixels of tiles that are not black, where something was drawn."""
    shown = picture.any(axis=0)
    result = np.zeros_like(shown)
    for y in range(0, len(shown), TILE):
        for x in range(0, shown.shape[1], TILE):
            result[y : y + TILE, x : x + TILE] = shown[y : y + TILE, x : x + TILE].any()
    return result


def measured(views: list[TrainingView], which: int, picture: np.ndarray, weight: float):  # type: ignore[no-untyped-def]
    """The row of the log, and the gradient where something was drawn."""
    loss = PictureLoss(DEVICE, IMAGE, MASK)
    loss.load(views)
    drawn = Rasterizer(DEVICE, 1)
    drawn.resize(loss.columns + 40, loss.rows)
    height, width = picture.shape[1:]
    planes = np.full(drawn.planes.shape, np.nan, np.float32)
    planes[:4, :height, :width] = picture
    drawn.planes.assign(planes)
    tiles = np.zeros(planes.shape[1:], bool)
    tiles[:height, :width] = covered(picture)
    drawn.starts.assign(np.cumsum([0, *tiles[::TILE, ::TILE].ravel()], dtype=np.int32))
    log = wp.zeros((3, COLUMNS), dtype=wp.float32, device=DEVICE)
    loss.measure(index(which), index(1), drawn, wp.zeros(1, dtype=wp.vec4, device=DEVICE), log)
    loss.carry_back(index(which), drawn, weight)
    rows = log.numpy()
    assert not rows[[0, 2]].any()
    return rows[1], drawn.g_planes.numpy()[:, :height, :width]


def expected(view: TrainingView, picture: np.ndarray, weight: float):  # type: ignore[no-untyped-def]
    """The same of the reference."""
    planes = torch.tensor(picture, dtype=torch.float64, requires_grad=True)
    count = len(view.target)
    exposure = leaf(view.exposure)
    shown = (planes[:count] * exposure[:, :1, None] + exposure[:, 1:, None]).permute(1, 2, 0)
    target = leaf(view.target).permute(1, 2, 0)
    image = IMAGE * losses.image_loss(shown[..., :3], target[..., :3])
    mask = MASK * losses.image_loss(shown[..., 3:], target[..., 3:]) if count > 3 else torch.zeros(())
    (weight * (image + mask)).backward()
    difference = (target - shown)[..., :3].detach()
    row = np.zeros(COLUMNS)
    row[[IMAGE_LOSS, MASK_LOSS, SQUARES]] = image.item(), mask.item(), (difference**2).sum()
    row[SHIFT : SHIFT + 3] = difference.mean(dim=(0, 1))
    return row, planes.grad.numpy() * covered(picture)


@pytest.mark.parametrize("mask", [True, False])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_losses_and_gradients_are_those_of_the_reference(width: int, height: int, mask: bool) -> None:
    view, picture = shot(width, height, mask=mask)
    (row, gradient), (true, true_gradient) = measured([view], 0, picture, 0.25), expected(view, picture, 0.25)
    assert row == pytest.approx(true, rel=CLOSE, abs=1e-6)
    for channel in range(4):
        if channel < len(view.target):
            assert apart(gradient[channel], true_gradient[channel]) < CLOSE
        else:
            assert not gradient[channel].any()


def test_pictures_of_several_sizes() -> None:
    shots = [shot(20, 33, 1), shot(48, 17, 2, mask=False), shot(9, 9, 3)]
    views = [view for view, _ in shots]
    for which, (view, picture) in enumerate(shots):
        (row, gradient), (true, true_gradient) = measured(views, which, picture, 1.0), expected(view, picture, 1.0)
        assert row == pytest.approx(true, rel=CLOSE, abs=1e-6)
        assert apart(gradient, true_gradient) < CLOSE


def test_equal_pictures_have_no_loss_and_no_gradient() -> None:
    view, _ = shot(20, 20)
    view = TrainingView("front", view.camera, view.target, np.float32([[1, 0]] * 4))
    row, gradient = measured([view], 0, view.target, 1.0)
    assert np.abs(row).max() < 1e-6
    assert np.abs(gradient).max() < 1e-6


def test_pictures_that_are_there_are_not_sent_again_and_exposures_are() -> None:
    view, _ = shot(16, 16)
    other, _ = shot(16, 16, 5)
    loss = PictureLoss(DEVICE, IMAGE, MASK)
    assert loss.load([view, other])
    targets = loss.targets.numpy().copy()
    view.target[:] = 7  # which nobody does
    loss.exposures.zero_()
    assert not loss.load([view, other])
    assert np.array_equal(loss.targets.numpy(), targets)
    assert np.array_equal(loss.exposures.numpy()[1], other.exposure)
    assert not loss.load([other])  # fewer views need no more room
    assert np.array_equal(loss.targets.numpy()[0], other.target)
    assert loss.load([view, shot(40, 16)[0]])


def test_images_of_8_bits_become_the_same_targets() -> None:
    rng = np.random.default_rng(0)
    levels = rng.integers(0, 256, (4, 21, 33)).astype(np.uint8)
    levels[3] %= 2
    target = np.concatenate([levels[:3] * np.float32(1 / 255), levels[3:].astype(np.float32)])
    made = PictureLoss(DEVICE, 1.0, 1.0)
    plain = view_of(target, camera(33, 21))
    image, mask = np.ascontiguousarray(np.moveaxis(levels[:3], 0, -1)), levels[3]
    made.load([replace(plain, target=target, source=(image, mask)), replace(plain, target=target.copy())])
    targets, moments = made.targets.numpy(), made.target_means.numpy()
    assert np.array_equal(targets[0, :, :21, :33], target)
    assert np.array_equal(targets[0], targets[1])
    assert np.array_equal(moments[0], moments[1])
