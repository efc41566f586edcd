"""The fused image loss against its float64 twin: value and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scas4d_core.engines.torch import losses
from scas4d_core.kernels import image_loss


@pytest.mark.parametrize(("height", "width"), [(7, 5), (40, 33), (16, 64), (50, 150)])
@pytest.mark.parametrize("shown", ["all", "a part", "a part, exposed", "nothing"])
def test_loss_and_gradients_agree_with_the_twin(height: int, width: int, shown: str) -> None:
    rng = np.random.default_rng(height)
    image = rng.uniform(size=(4, height + 3, width + 6)).astype(np.float32)
    target = rng.uniform(size=(3, height, width)).astype(np.float32)
    exposure = np.array([[1.1, 0.02], [0.9, -0.03], [1.0, 0.0]], np.float32)
    if shown in ("a part", "nothing"):
        exposure[:, 1] = 0
    if shown != "all":
        # Black but for a slanted bar, another one in the target, and a hole in both.
        rows, columns = np.mgrid[: height + 3, : width + 6]
        part = np.abs(columns - 0.4 * width - 0.5 * rows) < (0.1 * width if shown != "nothing" else 0)
        part[5:9] = False
        image *= part
        target *= np.roll(part, 3, axis=1)[:height, :width]
    weights = np.array([0.2, 0.3, 1.5], np.float32)

    leaf = torch.tensor(image[:3, :height, :width], dtype=torch.float64, requires_grad=True)
    model = torch.tensor(exposure, dtype=torch.float64, requires_grad=True)
    total = torch.zeros((), dtype=torch.float64)
    for channel in range(3):
        seen = model[channel, 0] * leaf[channel] + model[channel, 1]
        truth = torch.tensor(target[channel], dtype=torch.float64)
        total = total + weights[channel] * losses.image_loss(seen[..., None], truth[..., None])
    total.backward()

    scratch = np.zeros((6, 3, height + 10, image_loss.stride(width)), np.float32)
    means, squares = np.empty_like(target), np.empty_like(target)
    scratch[:, :, 5:-5] = np.nan  # what another picture left
    image_loss.target_moments(target, scratch, means, squares)
    g_image = np.full_like(image, np.nan)
    rows = np.empty((3, height, 2), np.float32)
    g_exposure = np.empty((3, height, 2), np.float32)
    image_loss.image_loss(
        2,
        image,
        exposure,
        target,
        means,
        squares,
        weights,
        target[0].size,
        scratch,
        image_loss.EVERYWHERE,
        g_image,
        rows,
        g_exposure,
    )

    np.testing.assert_allclose(rows[..., 0].sum(dtype=np.float64), total.item(), rtol=1e-5, atol=1e-9)
    seen = exposure[:, :1, None] * image[:3, :height, :width] + exposure[:, 1:, None]
    np.testing.assert_allclose(rows[..., 1].sum(1), np.square(seen - target).sum((1, 2)), rtol=1e-5)
    assert leaf.grad is not None
    assert model.grad is not None
    truth_gradient = leaf.grad.numpy()
    np.testing.assert_allclose(
        g_image[:3, :height, :width], truth_gradient, atol=2e-5 * np.abs(truth_gradient).max(), rtol=1e-4
    )
    np.testing.assert_allclose(g_exposure.sum(1), model.grad.numpy(), rtol=1e-3, atol=1e-5)


def test_a_picture_equal_to_its_target_has_no_loss() -> None:
    target = np.random.default_rng(0).uniform(size=(1, 20, 20)).astype(np.float32)
    scratch = np.zeros((6, 1, 30, image_loss.stride(20)), np.float32)
    means, squares = np.empty_like(target), np.empty_like(target)
    image_loss.target_moments(target, scratch, means, squares)
    g_image = np.empty_like(target)
    rows, g_exposure = np.empty((2, 1, 20, 2), np.float32)
    exposure, weights = np.array([[1.0, 0.0]], np.float32), np.ones(1, np.float32)
    image_loss.image_loss(
        1,
        target,
        exposure,
        target,
        means,
        squares,
        weights,
        target[0].size,
        scratch,
        image_loss.EVERYWHERE,
        g_image,
        rows,
        g_exposure,
    )
    assert abs(rows[..., 0].sum()) < 1e-6
    assert np.abs(g_image).max() < 1e-6


@pytest.mark.parametrize("bands", [1, 3])
@pytest.mark.parametrize("black", [False, True])
def test_a_part_has_the_bits_of_the_whole(black: bool, bands: int) -> None:
    """Gradients of the pixels asked for; and the loss that changes with them, as a difference."""
    height, width = 70, 90
    rng = np.random.default_rng(3)
    before, target = rng.uniform(size=(2, 3, height, width)).astype(np.float32)
    if black:
        before[:, :, 60:], target[:, :, 60:] = 0, 0
        before[:, 50:], target[:, 50:] = 0, 0
    shown = np.zeros((height, width), bool)
    shown[12:20, 30:38] = shown[40:44, 4:8] = shown[66:, 88:] = True
    after = np.where(shown, rng.uniform(size=before.shape).astype(np.float32), before)
    exposure = np.tile(np.array([1.1, 0], np.float32), (3, 1))
    means, squares = np.empty_like(target), np.empty_like(target)
    scratch = np.zeros((6, 3, height + 10, image_loss.stride(width)), np.float32)
    image_loss.target_moments(target, scratch, means, squares)

    def found(image: np.ndarray, wanted: np.ndarray, bands: int = 1) -> tuple[np.ndarray, np.ndarray]:
        scratch[:, :, 5:-5] = np.nan  # what another picture left
        gradient, rows = np.full_like(image, np.nan), np.empty((3, height, 2), np.float32)
        image_loss.image_loss(
            bands, image, exposure, target, means, squares, np.ones(3, np.float32), height * width, scratch, wanted,
            gradient, rows, np.empty_like(rows),
        )  # fmt: skip
        return gradient, rows.sum(axis=(0, 1), dtype=np.float64)

    near = image_loss.near(shown)
    gradient, losses = found(after, near, bands)
    wanted, whole = found(after, image_loss.EVERYWHERE)
    np.testing.assert_array_equal(found(after, image_loss.EVERYWHERE, bands)[0], wanted)
    np.testing.assert_array_equal(gradient[:, shown], wanted[:, shown])
    assert np.isnan(gradient).mean() > 0.5  # little else was computed
    untouched, base = found(before, near & (image_loss.WINDOWS | image_loss.LOSS))
    assert np.isnan(untouched).all()
    _, alone = found(before, np.full((1, 1), image_loss.LOSSES))
    np.testing.assert_allclose(alone, found(before, image_loss.EVERYWHERE)[1])
    np.testing.assert_allclose(alone - base + losses, whole, rtol=1e-6)
    assert abs(whole[0] - alone[0]) > 1e-4
