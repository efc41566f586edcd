"""The fused cascade against its float64 twin: values and gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scas4d_core import deformation, losses
from scas4d_core.kernels import cascade, deltas


def hierarchy(points: int, sizes: tuple[int, ...], rng: np.random.Generator) -> list[np.ndarray]:
    """Nested contiguous labels, coarse to fine."""
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


@pytest.mark.parametrize("kind", ["centred", "published"])
@pytest.mark.parametrize(("points", "sizes"), [(5, (2,)), (333, (3, 7, 20)), (1000, (1, 40))])
def test_cascade_and_deltas_agree_with_the_twin(kind: str, points: int, sizes: tuple[int, ...]) -> None:
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
        deformation.Deltas(own_leaf[:, :3], own_leaf[:, 3:6], own_leaf[:, 6:]), kind,
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
    about_origin = np.float32(kind == "published")
    nothing = np.tile(np.eye(3, dtype=np.float32).ravel(), (points, 1)), np.tile(np.float32([1, 0, 0, 0]), (points, 1))
    carried = [(x, *nothing)]
    tables = []
    for labels_k, values in zip(labels, parameters, strict=True):
        table = np.empty((len(values), cascade.TABLE), np.float32)
        cascade.cluster_tables(carried[-1][0], starts_of(labels_k), values, table)
        out = tuple(np.empty_like(array) for array in carried[-1])
        cascade.layer(*carried[-1], labels_k.astype(np.int32), table, about_origin, *out)
        carried.append(out)
        tables.append(table)
    rows = np.arange(points)
    means_out, factors_out, turns = np.empty_like(x), np.empty_like(factors), np.empty((points, 4), np.float32)
    deltas.apply_deltas(*carried[-1], own, rows, factors, means_out, factors_out, turns)
    np.testing.assert_allclose(means_out, twin.means.detach().numpy(), atol=3e-6)
    np.testing.assert_allclose(factors_out, twin.factors.detach().numpy(), atol=1e-6)
    np.testing.assert_allclose(turns, twin.turns.detach().numpy(), atol=2e-6)

    g_x, g_j, g_q = (np.empty_like(array) for array in carried[-1])
    g_own, excess = np.empty_like(own), np.empty(points, np.float32)
    deltas.apply_deltas_backward(
        *carried[-1], own, rows, factors, np.float32(10.0 / (3 * points)), bound, g_means, g_factors, g_turns,
        g_x, g_j, g_q, g_own, excess,
    )  # fmt: skip
    np.testing.assert_allclose(excess.sum() / (3 * points), scale.item(), rtol=1e-5)
    assert_close(g_own, own_leaf.grad)
    for k in reversed(range(len(sizes))):
        records = np.empty((points, cascade.RECORD), np.float32)
        cascade.layer_backward(*carried[k], labels[k].astype(np.int32), tables[k], about_origin, g_x, g_j, g_q, records)
        gradients = np.empty_like(parameters[k])
        cascade.cluster_gradients(records, starts_of(labels[k]), parameters[k], tables[k], gradients)
        assert_close(gradients, leaves[k].grad)


def assert_close(value: np.ndarray, expected: torch.Tensor | None) -> None:
    assert expected is not None
    truth = expected.numpy()
    np.testing.assert_allclose(value, truth, rtol=2e-4, atol=2e-5 * np.abs(truth).max())
