"""The losses against formulas written out pair by pair, and their gradients."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d

from scas4d_core.engines.torch import losses
from scas4d_core.engines.torch.deformation import quaternion_matrices, rotation_quaternions

M, K = 6, 3


def normal(*shape: int, seed: int = 0, scale: float = 1.0) -> torch.Tensor:
    return scale * torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def picture(seed: int, height: int = 9, width: int = 14, channels: int = 2) -> torch.Tensor:
    return torch.rand(height, width, channels, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def graph() -> tuple[torch.Tensor, torch.Tensor]:
    neighbours = torch.stack([(torch.arange(M) + step) % M for step in (1, 2, 4)], dim=1)
    return neighbours, picture(9, M, K, 1)[..., 0]


def turns(seed: int = 3) -> torch.Tensor:
    return rotation_quaternions(normal(M, 3, seed=seed, scale=0.3))


def test_ssim_of_a_picture_with_itself_is_one() -> None:
    torch.testing.assert_close(losses.ssim_map(picture(1), picture(1)), torch.ones(9, 14, 2, dtype=torch.float64))
    assert losses.image_loss(picture(1), picture(1)).abs() < 1e-15


def test_ssim_against_scipy() -> None:
    x, y = picture(1).numpy(), picture(2).numpy()
    offsets = np.arange(-5, 6)
    window = np.exp(-(offsets**2) / (2 * 1.5**2))
    window /= window.sum()

    def blurred(values: np.ndarray) -> np.ndarray:
        across = correlate1d(values, window, axis=1, mode="constant")
        return correlate1d(across, window, axis=0, mode="constant")

    mx, my = blurred(x), blurred(y)
    vx, vy, cov = blurred(x * x) - mx * mx, blurred(y * y) - my * my, blurred(x * y) - mx * my
    expected = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    found = losses.ssim_map(picture(1), picture(2)).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    loss = losses.image_loss(picture(1), picture(2)).item()
    assert loss == pytest.approx(0.8 * np.abs(x - y).mean() + 0.2 * (1 - expected.mean()), rel=1e-12)


@pytest.mark.parametrize("rows", [None, torch.tensor([4, 1])])
def test_neighbour_terms_pair_by_pair(rows: torch.Tensor | None) -> None:
    means, previous, q = normal(M, 3), normal(M, 3, seed=1), turns()
    neighbours, weights = graph()
    distances = picture(5, M, K, 1)[..., 0]
    matrices = quaternion_matrices(q)
    rigid, iso, rot = [], [], []
    for i in range(M) if rows is None else rows.tolist():
        for slot in range(K):
            j, w = int(neighbours[i, slot]), float(weights[i, slot])
            offset = means[j] - means[i]
            rigid.append(math.sqrt(w) * (matrices[i].T @ offset - (previous[j] - previous[i])).norm().item())
            iso.append(math.sqrt(w) * abs(offset.norm().item() - distances[i, slot].item()))
            rot.append(math.sqrt(w) * (q[j] - q[i]).norm().item())
    assert losses.rigidity_loss(means, q, previous, neighbours, weights, rows).item() == pytest.approx(np.mean(rigid))
    assert losses.isometry_loss(means, distances, neighbours, weights, rows).item() == pytest.approx(np.mean(iso))
    assert losses.rotation_loss(q, neighbours, weights, rows).item() == pytest.approx(np.mean(rot))


def test_a_rigid_motion_costs_nothing() -> None:
    previous = normal(M, 3)
    q = rotation_quaternions(torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64)).expand(M, 4)
    means = previous @ quaternion_matrices(q[0]).T + torch.tensor([1.0, 2, 3], dtype=torch.float64)
    neighbours, weights = graph()
    distances = (previous[neighbours] - previous[:, None]).norm(dim=-1)
    assert losses.rigidity_loss(means, q, previous, neighbours, weights) < 1e-9
    assert losses.isometry_loss(means, distances, neighbours, weights) < 1e-9
    assert losses.rotation_loss(q, neighbours, weights) < 1e-9
    still = previous.clone().requires_grad_()
    losses.isometry_loss(still, distances, neighbours, weights).backward()
    assert still.grad is not None
    assert still.grad.isfinite().all()


def test_scale_loss_counts_only_what_outgrew_both_limits() -> None:
    factors = torch.diag_embed(torch.tensor([[0.01, 0.03, 0.05], [0.02, 0.02, 0.07]], dtype=torch.float64))
    first = torch.tensor([[0.001, 0.001, 0.04], [0.001, 0.1, 0.1]], dtype=torch.float64)
    # 0.03 over 0.02 and 0.05 over 0.04; everything else is within its limit. Six axes.
    assert losses.scale_loss(factors, first, 0.02).item() == pytest.approx((0.01 + 0.01) / 6)


def test_axis_lengths_are_of_columns() -> None:
    factor = torch.tensor([[[1.0, 0, 0], [2, 1, 0], [2, 0, 3]]], dtype=torch.float64)
    assert losses.axis_lengths(factor).tolist() == [[3, 1, 3]]


def test_soft_colour_loss_is_the_mean_over_rows_and_channels() -> None:
    now, before = torch.tensor([[0.1, 0.2, 0.3], [0, 0, 0]]), torch.tensor([[0.1, 0.1, 0.1], [0, 0, 0.3]])
    assert losses.soft_colour_loss(now, before).item() == pytest.approx(0.1)


def test_gradients() -> None:
    neighbours, weights = graph()
    rows, distances, previous = torch.tensor([0, 2, 5]), picture(5, M, K, 1)[..., 0], normal(M, 3, seed=1)
    means, q, factors = normal(M, 3).requires_grad_(), turns().requires_grad_(), normal(M, 3, 3).requires_grad_()
    first = torch.full((M, 3), 0.5, dtype=torch.float64)
    image, target = picture(1, 6, 5).requires_grad_(), picture(2, 6, 5)
    check = torch.autograd.gradcheck
    assert check(lambda m, r: losses.rigidity_loss(m, r, previous, neighbours, weights, rows), (means, q))
    assert check(lambda m: losses.isometry_loss(m, distances, neighbours, weights, rows), (means,))
    assert check(lambda r: losses.rotation_loss(r, neighbours, weights, rows), (q,))
    assert check(lambda f: losses.scale_loss(f, first, 1.0), (factors,))
    assert check(lambda i: losses.image_loss(i, target), (image,))
    assert check(lambda colours: losses.soft_colour_loss(colours, previous), (means,))
