"""The fused neighbour terms and Adam against their twins."""

from __future__ import annotations

import numpy as np
import torch

from scas4d_core.engines.torch import losses
from scas4d_core.kernels import adam, neighbour_terms


def test_losses_and_gradients_agree_with_the_twin() -> None:
    rng = np.random.default_rng(1)
    count, k = 200, 6
    means, previous = (rng.normal(size=(count, 3)).astype(np.float32) for _ in range(2))
    turns = rng.normal(size=(count, 4)) * 0.2 + np.array([1, 0, 0, 0])
    turns = (turns / np.linalg.norm(turns, axis=1, keepdims=True)).astype(np.float32)
    neighbours = np.array([rng.choice(np.delete(np.arange(count), i), k, replace=False) for i in range(count)])
    weights = rng.uniform(0.1, 1, size=(count, k)).astype(np.float32)
    weights[rng.random(size=weights.shape) < 0.1] = 0  # no neighbour
    distances = rng.uniform(0.5, 2, size=(count, k)).astype(np.float32)
    sample = rng.choice(count, 61, replace=False)
    strengths = np.array([4.0, 2.0, 3.0], np.float32) / (len(sample) * k)

    leaves = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in (means, turns)]
    graph = torch.tensor(neighbours), torch.tensor(weights, dtype=torch.float64)
    rows = torch.tensor(sample)
    expected = [
        losses.rigidity_loss(leaves[0], leaves[1], torch.tensor(previous, dtype=torch.float64), *graph, rows),
        losses.isometry_loss(leaves[0], torch.tensor(distances, dtype=torch.float64), *graph, rows),
        losses.rotation_loss(leaves[1], *graph, rows),
    ]
    (4 * expected[0] + 2 * expected[1] + 3 * expected[2]).backward()

    state = np.zeros((count, 16), np.float32)
    state[:, :3], state[:, 3:7], state[:, 7:10] = means, turns, previous
    accumulators = np.full((neighbour_terms.TASKS, count, 8), np.nan, np.float32)
    sums = np.empty((neighbour_terms.TASKS, 3), np.float32)
    neighbour_terms.neighbour_terms(
        state, sample, neighbours.astype(np.int32), weights, distances, strengths, accumulators, sums
    )
    tied = np.full((count, 8), np.nan, np.float32)
    neighbour_terms.sum_accumulators(accumulators, 0, count, tied)
    g_means, g_turns = tied[:, :3], tied[:, 3:7]
    np.testing.assert_allclose(sums.sum(0) / (len(sample) * k), [loss.item() for loss in expected], rtol=1e-5)
    for value, leaf in zip((g_means, g_turns), leaves, strict=True):
        assert leaf.grad is not None
        truth = leaf.grad.numpy()
        np.testing.assert_allclose(value, truth, rtol=1e-3, atol=1e-5 * np.abs(truth).max())


def test_adam_agrees_with_torch() -> None:
    rng = np.random.default_rng(2)
    parameters = rng.normal(size=(50, 2)).astype(np.float32)
    leaves = [torch.tensor(parameters[:, k].astype(np.float64), requires_grad=True) for k in range(2)]
    optimizer = torch.optim.Adam(
        [{"params": [leaves[0]], "lr": 0.1}, {"params": [leaves[1]], "lr": 0.01}], betas=(0.9, 0.99), eps=1e-15
    )
    first, second = np.zeros_like(parameters), np.zeros_like(parameters)
    for step in range(1, 6):
        gradient = rng.normal(size=(50, 2)).astype(np.float32) * 1e-6
        for k in range(2):
            leaves[k].grad = torch.tensor(gradient[:, k].astype(np.float64))
        optimizer.step()
        rates = np.array([0.1, 0.01], np.float32)
        adam.adam(parameters, gradient, first, second, rates, adam.EVERY_ROW, np.float32(0.9), np.float32(0.99), step)
    np.testing.assert_allclose(parameters, np.stack([leaf.detach().numpy() for leaf in leaves], 1), atol=2e-6)
