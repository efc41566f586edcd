"""The fused cascade against its float64 twin: values and gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest
import torch

from scas4d_core.engines.cpu.deformation import Blocks, CpuDeformation
from scas4d_core.engines.torch import deformation, losses
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy


def hierarchy(points: int, sizes: tuple[int, ...], rng: np.random.Generator) -> list[np.ndarray]:
    """Nested contiguous labels, coarse to fine."""
    if not sizes:
        return []
    cuts = np.sort(rng.choice(np.arange(1, points), sizes[-1] - 1, replace=False))
    fine = np.searchsorted(cuts, np.arange(points), side="right")
    labels = [fine]
    for size in reversed(sizes[:-1]):
        below = labels[0].max() + 1
        parents = np.sort(np.concatenate([np.arange(size), rng.integers(0, size, below - size)]))
        labels.insert(0, parents[labels[0]])
    return labels


def starts_of(labels: np.ndarray) -> np.ndarray:
    return np.searchsorted(labels, np.arange(labels.max() + 2)).astype(np.int64)


@pytest.mark.parametrize("covariance", ["entangled", "separate"])
@pytest.mark.parametrize("kind", ["centred", "published"])
@pytest.mark.parametrize(("points", "sizes"), [(5, ()), (5, (2,)), (333, (3, 7, 20)), (1000, (1, 40))])
def test_cascade_and_deltas_agree_with_the_twin(
    kind: str, points: int, sizes: tuple[int, ...], covariance: str
) -> None:
    rng = np.random.default_rng(points)
    labels = hierarchy(points, sizes, rng)
    x = rng.normal(size=(points, 3)).astype(np.float32)
    factors = (0.05 * rng.normal(size=(points, 3, 3))).astype(np.float32)
    parameters = [(0.3 * rng.normal(size=(size, 10))).astype(np.float32) for size in sizes]
    own = (0.2 * rng.normal(size=(points, 9))).astype(np.float32)
    g_means, g_factors, g_turns = (
        rng.normal(size=(points, *shape)).astype(np.float32) for shape in ((3,), (3, 3), (4,))
    )
    bound = np.full((points, 3), 0.08, np.float32)

    # The twin.
    layers = []
    leaves = []
    for labels_k, values in zip(labels, parameters, strict=True):
        leaf = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        leaves.append(leaf)
        params = deformation.ClusterParams(leaf[:, :3], leaf[:, 3:6], leaf[:, 6:9], leaf[:, 9])
        layers.append(deformation.Layer(torch.tensor(labels_k, dtype=torch.int64), params))
    own_leaf = torch.tensor(own, dtype=torch.float64, requires_grad=True)
    twin = deformation.deform(
        torch.tensor(x, dtype=torch.float64), torch.tensor(factors, dtype=torch.float64), layers,
        deformation.Deltas(own_leaf[:, :3], own_leaf[:, 3:6], own_leaf[:, 6:]), kind, covariance,
    )  # fmt: skip
    scale = losses.scale_loss(twin.factors, torch.full((points, 3), 0.08, dtype=torch.float64), 0.01)
    total = (
        (twin.means * torch.tensor(g_means)).sum()
        + (twin.factors * torch.tensor(g_factors)).sum()
        + (twin.turns * torch.tensor(g_turns)).sum()
        + 10.0 * scale
    )
    total.backward()

    # The kernels.
    rows = rng.permutation(points)
    model = CpuDeformation(
        Hierarchy(rows, tuple(k.astype(np.int32) for k in labels), tuple(starts_of(k) for k in labels)),
        None, bound, kind, covariance,
    )  # fmt: skip
    model.start(gaussians(scattered(x, rows), scattered(factors, rows)))
    for table, values in zip([*model.clusters, model.deltas], [*parameters, own], strict=True):
        table[:] = values
    model.forward()
    means = twin.means.detach().numpy()
    np.testing.assert_allclose(model.means[rows], means, rtol=0, atol=3e-7 * np.abs(means).max())  # five roundings
    np.testing.assert_allclose(model.factors[rows], twin.factors.detach().numpy(), atol=1e-6)
    np.testing.assert_allclose(model.turns, twin.turns.detach().numpy(), atol=2e-6)

    model._accumulators[0, :, 3:7] = g_turns
    excess = model.backward(scattered(g_means, rows), scattered(g_factors, rows), 10.0)
    np.testing.assert_allclose(excess, scale.item(), rtol=1e-5)
    assert_close(model.delta_gradients, own_leaf.grad)
    for gradients, leaf in zip(model.cluster_gradients, leaves, strict=True):
        assert_close(gradients, leaf.grad)


def scattered(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Entries in the hierarchy's order, put where they are among all Gaussians."""
    result = np.empty_like(values)
    result[rows] = values
    return result


def gaussians(means: np.ndarray, factors: np.ndarray) -> Gaussians:
    ones = np.ones(len(means), np.float32)
    turns = np.tile(np.float32([1, 0, 0, 0]), (len(means), 1))
    return Gaussians(means, factors, turns, ones, np.zeros_like(means), ones, np.arange(len(means)))


def test_blocks_hold_every_gaussian_once_and_one_cluster_of_each_layer() -> None:
    labels = hierarchy(333, (3, 7, 20), np.random.default_rng(3))
    starts = tuple(starts_of(layer) for layer in labels)
    blocks = Blocks.of(Hierarchy(np.arange(333), tuple(layer.astype(np.int32) for layer in labels), starts))
    np.testing.assert_array_equal(np.sort(blocks.entries[blocks.present > 0]), np.arange(333))
    for layer, of_points in enumerate(labels):
        of_blocks = blocks.clusters[:, layer, None] - blocks.offsets[layer]
        np.testing.assert_array_equal(of_points[blocks.entries], np.broadcast_to(of_blocks, blocks.entries.shape))
        for cluster, (first, last, count) in enumerate(
            blocks.ranges[blocks.offsets[layer] :][: len(starts[layer]) - 1]
        ):
            held = blocks.entries[first:last][blocks.present[first:last] > 0]
            np.testing.assert_array_equal(np.sort(held), np.flatnonzero(of_points == cluster))
            assert count == len(held)


def assert_close(value: np.ndarray, expected: torch.Tensor | None) -> None:
    assert expected is not None
    truth = expected.numpy()
    np.testing.assert_allclose(value, truth, rtol=2e-4, atol=2e-5 * np.abs(truth).max())


@pytest.mark.parametrize("kind", ["centred", "published"])
def test_layers_that_rest_are_applied_once_and_all_else_keeps_its_bits(kind: Literal["centred", "published"]) -> None:
    rng = np.random.default_rng(7)
    labels = hierarchy(333, (3, 7, 20), rng)
    layers = tuple(k.astype(np.int32) for k in labels), tuple(starts_of(k) for k in labels)
    state = gaussians(*(rng.normal(size=(333, *shape)).astype(np.float32) for shape in ((3,), (3, 3))))
    g_means, g_factors = (rng.normal(size=(333, *shape)).astype(np.float32) for shape in ((3,), (3, 3)))
    bound = np.full((333, 3), 0.08, np.float32)
    parameters = [(0.2 * rng.normal(size=(size, 10))).astype(np.float32) for size in (3, 7, 20)]
    more = [(0.1 * rng.normal(size=(size, 10))).astype(np.float32) for size in (3, 7, 20)]

    def found(rests: Sequence[int]) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """After each change of what goes on, with so many layers at rest; the last layers' gradients with it."""
        model = CpuDeformation(Hierarchy(np.arange(333), *layers), None, bound, kind)
        model.start(state)
        outputs, gradients = list[np.ndarray](), list[np.ndarray]()
        for table, values in zip(model.clusters, parameters, strict=True):
            table[:] = values
        model.forward()
        for going, resting in zip((0, 1, 2, 0), rests, strict=True):
            model.freeze_layers(resting)
            for table, values in zip(model.clusters[going:], more[going:], strict=True):
                table += values
            model.forward()
            outputs += [model.means.copy(), model.factors.copy(), model.turns.copy()]
            model.backward(g_means, g_factors, 0.1)
            gradients += [model.delta_gradients.copy(), *(one.copy() for one in model.cluster_gradients[going:])]
        return outputs, gradients

    for resting, going in zip(found((0, 1, 2, 0)), found((0, 0, 0, 0)), strict=True):
        for one, other in zip(resting, going, strict=True):
            np.testing.assert_array_equal(one, other)


def test_the_last_layer_does_not_rest() -> None:
    labels = np.zeros(5, np.int32)
    model = CpuDeformation(Hierarchy(np.arange(5), (labels,), (starts_of(labels),)), None, np.ones((5, 3)), "centred")
    with pytest.raises(ValueError, match="cannot freeze 1 of 1 layers"):
        model.freeze_layers(1)
