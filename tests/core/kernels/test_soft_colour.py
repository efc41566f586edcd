"""Soft-colour kernel against the torch reference: loss and gradient."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scas4d_core.engines.torch.losses import soft_colour_loss
from scas4d_core.kernels.soft_colour import soft_colour


@pytest.mark.parametrize("subset", [False, True])
def test_loss_and_gradient_equal_those_of_the_reference(subset: bool) -> None:
    rng = np.random.default_rng(0)
    count = 700
    rows = np.sort(rng.choice(2 * count, count, replace=False)) if subset else np.zeros(0, np.int64)
    g_features = rng.normal(size=(2 * count if subset else count, 4)).astype(np.float32)
    before, colours = rng.random((2, count, 3), np.float32)
    colours[:100] = before[:100]
    weight, gradients = np.float32(0.3), np.empty_like(colours)
    change = soft_colour(colours, before, rows, g_features, weight / np.float32(colours.size), gradients)

    leaf = torch.tensor(colours, requires_grad=True)
    loss = float(weight) * soft_colour_loss(leaf, torch.tensor(before))
    (expected,) = torch.autograd.grad(loss, leaf)
    assert change * weight / colours.size == pytest.approx(loss.item(), rel=1e-6)
    rendered = g_features[rows] if subset else g_features
    np.testing.assert_allclose(gradients, rendered[:, :3] + expected.numpy(), rtol=1e-6, atol=1e-9)
