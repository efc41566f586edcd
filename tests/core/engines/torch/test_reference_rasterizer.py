"""The torch rasterizer against pixels worked out by hand, and its gradients."""

import math

import numpy as np
import pytest
import torch

from scas4d_core.cameras import Camera
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.torch import rasterizer as twin
from scas4d_core.engines.torch.rasterizer import CameraParams

WIDTH, HEIGHT = 12, 9
CAMERA = Camera("c", [[20.0, 0, 5.5], [0, 22, 4.5], [0, 0, 1]], np.eye(4), WIDTH, HEIGHT)  # type: ignore[arg-type]
PARAMS = CameraParams.of(CAMERA)
BLACK = torch.zeros(3, dtype=torch.float64)
RED, GREEN = [1.0, 0, 0], [0, 1.0, 0]


def tensor(values: object) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def balls(sigma: float, count: int) -> torch.Tensor:
    return (sigma * torch.eye(3, dtype=torch.float64)).repeat(count, 1, 1)


def some_gaussians(count: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, dtype=torch.float64, generator=g) * tensor([0.5, 0.35, 1]) + tensor([-0.25, -0.18, 1])
    factors = 0.04 * torch.randn(count, 3, 3, dtype=torch.float64, generator=g)
    opacities = 0.3 + 0.5 * torch.rand(count, dtype=torch.float64, generator=g)
    features = torch.rand(count, 4, dtype=torch.float64, generator=g)
    return means, factors, opacities, features


def test_one_gaussian_by_hand() -> None:
    # On the axis at z = 2, σ = 0.1 m: 1 px across x and 1.1 px across y, squared, plus the low-pass of 0.3 px².
    picture = twin.render(tensor([[0, 0, 2]]), balls(0.1, 1), tensor([0.7]), tensor([RED]), PARAMS, tensor([0, 0, 1.0]))
    vx, vy = 1.0 + 0.3, 1.21 + 0.3
    assert picture.means.tolist() == [[5.5, 4.5]]
    assert picture.depths.tolist() == [2]
    for column, row in [(5, 4), (6, 4), (5, 6), (3, 3)]:
        dx, dy = column + 0.5 - 5.5, row + 0.5 - 4.5  # pixel centres at +0.5: (5, 4) is hit in its very middle
        alpha = 0.7 * math.exp(-0.5 * (dx * dx / vx + dy * dy / vy))
        assert picture.alpha[row, column].item() == pytest.approx(alpha, rel=1e-12)
        assert picture.features[row, column].tolist() == pytest.approx([alpha, 0, 1 - alpha], rel=1e-12)


def test_support_ends_exactly_at_the_floor() -> None:
    picture = twin.render(tensor([[0, 0, 2]]), balls(0.1, 1), tensor([0.7]), tensor([RED]), PARAMS, BLACK)
    reach = math.sqrt(2 * 1.3 * math.log(0.7 * 255))  # about 3.67 px along the row of the mean
    drawn = [abs(column + 0.5 - 5.5) <= reach for column in range(WIDTH)]
    assert (picture.alpha[4] > 0).tolist() == drawn
    assert picture.alpha[4][picture.alpha[4] > 0].min() >= 1 / 255


def test_nearer_gaussian_covers_the_farther_whatever_the_rows() -> None:
    colours, opacities = tensor([RED, GREEN]), tensor([0.6, 0.5])
    picture = twin.render(
        tensor([[0, 0, 3], [0, 0, 2]]), balls(0.1, 2), opacities, colours, PARAMS, tensor([0, 0, 1.0])
    )
    assert picture.features[4, 5].tolist() == pytest.approx([0.5 * 0.6, 0.5, 0.5 * 0.4], rel=1e-12)


def test_ties_go_by_row() -> None:
    colours, opacities = tensor([RED, GREEN]), tensor([0.6, 0.5])
    picture = twin.render(tensor([[0, 0, 2], [0, 0, 2]]), balls(0.1, 2), opacities, colours, PARAMS, BLACK)
    assert picture.features[4, 5].tolist() == pytest.approx([0.6, 0.4 * 0.5, 0], rel=1e-12)


def test_cap_and_no_gradient_through_it() -> None:
    opacities = tensor([0.999]).requires_grad_()
    picture = twin.render(tensor([[0, 0, 2]]), balls(0.1, 1), opacities, tensor([RED]), PARAMS, BLACK)
    assert picture.alpha[4, 5].item() == pytest.approx(0.99)
    assert torch.autograd.grad(picture.alpha[4, 5], opacities)[0].item() == 0
    other = twin.render(
        tensor([[0, 0, 2]]), balls(0.1, 1), opacities, tensor([RED]), PARAMS, BLACK, Limits(alpha_cap=0.999)
    )
    assert other.alpha[4, 5].item() == pytest.approx(0.999)


def test_the_gaussian_that_would_cross_the_stop_is_not_drawn_nor_any_behind() -> None:
    means, colours = tensor([[0, 0, 2], [0, 0, 2.1], [0, 0, 2.2], [0, 0, 2.3]]), tensor([RED, RED, GREEN, [0, 0, 1.0]])
    opacities = tensor([0.95, 0.95, 0.98, 0.01])
    picture = twin.render(means, balls(0.1, 4), opacities, colours, PARAMS, BLACK)
    # 0.05·0.05 = 2.5e-3 remain; 0.98 would leave 5e-5 < 1e-4. Blue alone would leave enough, but comes after.
    assert picture.features[4, 5].tolist() == pytest.approx([1 - 2.5e-3, 0, 0], rel=1e-12)
    assert picture.alpha[4, 5].item() == pytest.approx(1 - 2.5e-3, rel=1e-12)


def test_behind_and_too_near_are_culled_without_poisoning_gradients() -> None:
    means = tensor([[0, 0, -2], [0, 0, 0], [0, 0, 0.009], [0, 0, 2]]).requires_grad_()
    picture = twin.render(means, balls(0.1, 4), tensor([0.7] * 4), tensor([RED] * 4), PARAMS, BLACK)
    alone = twin.render(means[3:], balls(0.1, 1), tensor([0.7]), tensor([RED]), PARAMS, BLACK)
    torch.testing.assert_close(picture.features, alone.features)
    (gradient,) = torch.autograd.grad(picture.features[4, 6].sum(), means)
    assert gradient[:3].abs().max() == 0
    assert gradient[3, 0] > 0
    nothing = twin.render(
        means[:2], balls(0.1, 2), tensor([0.7] * 2), tensor([RED] * 2), PARAMS, tensor([0.1, 0.2, 0.3])
    )
    assert nothing.features[0, 0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert nothing.alpha.abs().max() == 0


def test_projection_agrees_with_the_camera_and_its_derivative() -> None:
    pose = np.eye(4)
    pose[:3, :3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]]
    pose[:3, 3] = [0, 0, 1.5] - pose[:3, :3] @ [0, 0, 1.5]  # turned about the middle of the Gaussians
    camera = Camera("turned", CAMERA.intrinsics, pose, WIDTH, HEIGHT)
    params, (means, factors, _, _) = CameraParams.of(camera), some_gaussians(8)
    projected = twin.project(means, factors, params)
    uv, depth = camera.project(means.numpy())
    np.testing.assert_allclose(projected.means.numpy(), uv, rtol=1e-12)
    np.testing.assert_allclose(projected.depths.numpy(), depth, rtol=1e-12)
    np.testing.assert_allclose(params.depths(means).numpy(), depth, rtol=1e-12)
    inside = (np.abs((uv - [6, 4.5]) / [6, 4.5]) < 1.2).all(axis=1)
    assert inside.sum() >= 4
    by_means = torch.autograd.functional.jacobian(lambda x: twin.project(x, factors, params).means, means)
    a = by_means.diagonal(dim1=0, dim2=2).permute(2, 0, 1)
    expected = a @ factors @ factors.mT @ a.mT + 0.3 * torch.eye(2, dtype=torch.float64)
    torch.testing.assert_close(projected.covariances[inside], expected[inside])


def test_jacobian_is_held_at_the_margin_outside_the_picture() -> None:
    limit = (WIDTH - 5.5) / 20 + 0.3 * WIDTH / (2 * 20)
    far, edge = (twin.project(tensor([[2 * tan, 0, 2]]), balls(0.1, 1), PARAMS) for tan in (3.0, limit))
    torch.testing.assert_close(far.covariances, edge.covariances)
    nearer = twin.project(tensor([[2 * (limit - 0.01), 0, 2]]), balls(0.1, 1), PARAMS)
    assert (nearer.covariances - edge.covariances).abs().max() > 1e-3
    left = twin.project(tensor([[-6.0, 0, 2]]), balls(0.1, 1), PARAMS)
    tan = 5.5 / 20 + 0.3 * WIDTH / (2 * 20)
    assert left.covariances[0, 0, 0].item() == pytest.approx((0.1 * 20 / 2) ** 2 * (1 + tan**2) + 0.3, rel=1e-12)


def test_gradients_of_everything() -> None:
    means, factors, opacities, features = (x.requires_grad_() for x in some_gaussians(5))
    background = tensor([0.2, 0.4, 0.1, 0.3]).requires_grad_()
    # A low floor keeps central differences away from the support's edge, where the picture jumps by 1/255.
    limits = DEFAULT._replace(alpha_floor=1e-12)

    def drawn(*inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        picture = twin.render(*inputs[:4], PARAMS, inputs[4], limits)
        return picture.features, picture.alpha

    assert torch.autograd.gradcheck(drawn, (means, factors, opacities, features, background))


def test_strips_draw_the_same_picture_and_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = [x.requires_grad_() for x in some_gaussians(20)]
    background = torch.zeros(4, dtype=torch.float64)
    whole = twin.render(*inputs, PARAMS, background)
    whole_gradients = torch.autograd.grad((whole.features**2).sum() + whole.alpha.sum(), inputs)
    monkeypatch.setattr(twin, "PAIRS_AT_ONCE", 20 * 10)
    strips = twin.render(*inputs, PARAMS, background)
    torch.testing.assert_close(strips.features, whole.features)
    gradients = torch.autograd.grad((strips.features**2).sum() + strips.alpha.sum(), inputs)
    for found, expected in zip(gradients, whole_gradients, strict=True):
        torch.testing.assert_close(found, expected)


def test_projected_means_carry_the_screen_gradient() -> None:
    means, factors, opacities, features = (x.requires_grad_() for x in some_gaussians(3))
    picture = twin.render(means, factors, opacities, features, PARAMS, torch.zeros(4, dtype=torch.float64))
    picture.means.retain_grad()
    (picture.features**2).sum().backward()
    assert picture.means.grad is not None
    assert picture.means.grad.abs().max() > 0
