"""Frame 0's parameters to Gaussians, against the same formulas in float64 torch: values and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scas4d_core.engines.torch.deformation import quaternion_matrices
from scas4d_core.kernels import activation


def parameters(count: int) -> np.ndarray:
    rng = np.random.default_rng(count)
    table = rng.normal(size=(count, activation.COLUMNS))
    table[:, 3:7] *= rng.uniform(0.1, 10, (count, 1))  # quaternions of any length
    table[:, 7:10] = rng.uniform(-9, 1, (count, 3))
    table[:, 10] = rng.uniform(-8, 8, count)
    return table.astype(np.float32)


def twin(table: torch.Tensor) -> list[torch.Tensor]:
    """Means, factors, opacities, features."""
    q = table[:, 3:7]
    rotations = quaternion_matrices(q / q.norm(dim=1, keepdim=True))
    features = torch.cat([table[:, 11:14], torch.sigmoid(table[:, 14:])], dim=1)
    return [table[:, :3], rotations * torch.exp(table[:, None, 7:10]), torch.sigmoid(table[:, 10]), features]


@pytest.mark.parametrize("count", [1, 700])
def test_values_and_gradients_agree_with_the_twin(count: int) -> None:
    table = parameters(count)
    leaf = torch.tensor(table, dtype=torch.float64, requires_grad=True)
    expected = twin(leaf)
    shapes = [(count, 3), (count, 3, 3), (count,), (count, 4)]
    found = [np.full(shape, np.nan, np.float32) for shape in shapes]
    activation.activate(table, *found)
    for value, truth in zip(found, expected, strict=True):
        np.testing.assert_allclose(value, truth.detach().numpy(), rtol=2e-6, atol=2e-7 * truth.abs().max().item())

    rng = np.random.default_rng(1)
    pulls = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
    pulled = [(truth * torch.tensor(pull)).sum() for truth, pull in zip(expected, pulls, strict=True)]
    torch.stack(pulled).sum().backward()
    gradients = np.full_like(table, np.nan)
    _, factors, opacities, features = found
    activation.activate_backward(table, factors, opacities, features, *pulls, gradients)
    assert leaf.grad is not None
    truth = leaf.grad.numpy()
    for columns in (slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 11), slice(11, 14), slice(14, 15)):
        row = np.abs(truth[:, columns]).max(axis=1, keepdims=True)
        assert (np.abs(gradients[:, columns] - truth[:, columns]) <= 1e-4 * row + 1e-6).all(), columns
