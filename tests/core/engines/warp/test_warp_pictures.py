"""The pictures of an iteration in Warp, on its CPU device, against the reference in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

from engine_cases import apart
from warp_cases import BACKGROUND, DEVICE, LIMITS, Cloud, camera, cloud, drawn, index, view_of

from scas4d_core.engines.plan import UpdatePlan
from scas4d_core.engines.torch import losses
from scas4d_core.engines.torch.parameters import leaf
from scas4d_core.engines.views import TrainingView
from scas4d_core.engines.warp.layout import IMAGE_LOSS, MASK_LOSS, PAIRS, SQUARES
from scas4d_core.engines.warp.pictures import PicturePass

CLOSE = 1e-4
PLAN = UpdatePlan(cameras=("front",), background=BACKGROUND, limits=LIMITS, image=1.5, mask=3.0)
GIVEN = cloud(120)
SIZES = [(37, 29), (48, 16), (16, 40)]


def views() -> list[TrainingView]:
    """Pictures of a scene that differs a little, in several sizes; the second has no mask."""
    other = GIVEN._replace(means=GIVEN.means + np.float32(0.02))
    made = []
    for number, size in enumerate(SIZES):
        features, _ = drawn(other.tensors(), camera(*size))
        picture = features.permute(2, 0, 1).detach().numpy()
        made.append(view_of(picture, camera(*size), number, mask=number != 1))
    return made


def reference(view: TrainingView, given: Cloud = GIVEN, plan: UpdatePlan = PLAN):  # type: ignore[no-untyped-def]
    """Weighted losses, squared error, and gradients of means, factors and features."""
    tensors, count = given.tensors(), len(view.target)
    features, _ = drawn(tensors, view.camera, background=plan.background)
    exposure, target = leaf(view.exposure), leaf(view.target).permute(1, 2, 0)
    shown = features[..., :count] * exposure[:, 0] + exposure[:, 1]
    image = plan.image * losses.image_loss(shown[..., :3], target[..., :3])
    mask = plan.mask * losses.image_loss(shown[..., 3:], target[..., 3:]) if count > 3 else torch.zeros(())
    (image + mask).backward()
    squares = ((shown - target)[..., :3] ** 2).sum()
    row = [image.item(), mask.item(), squares.item()]
    return row, [tensors[k].grad.numpy() for k in (0, 1, 3)]


def loaded() -> PicturePass:
    made = PicturePass(DEVICE, PLAN, len(GIVEN.means))
    made.load_views(views())
    return made


def gradients(made: PicturePass) -> list[np.ndarray]:
    return [array.numpy() for array in (made.grad_means, made.grad_factors, made.grad_features)]


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_view_has_the_losses_and_gradients_of_the_reference(which: int) -> None:
    made, view = loaded(), views()[which]
    made.reserve(4)
    made.launch(index(which), index(2), *GIVEN.on_device(), 1.0, add=False)
    row, true = reference(view)
    log = made.log.numpy()
    assert log[2, [IMAGE_LOSS, MASK_LOSS, SQUARES]] == pytest.approx(row, rel=CLOSE)
    assert log[2, PAIRS] > 100
    assert not log[[0, 1, 3]].any()
    for mine, expected in zip(gradients(made), true, strict=True):
        assert np.linalg.norm(expected) > 0
        assert apart(mine, expected) < CLOSE
    features, rest = drawn(GIVEN.tensors(), view.camera)
    planes = made.planes.numpy()[:, : view.camera.height, : view.camera.width]
    assert apart(planes[:4], features.permute(2, 0, 1).detach().numpy()) < CLOSE
    assert apart(planes[4], rest.detach().numpy()) < CLOSE


def test_gradients_of_several_views_add_up() -> None:
    made = loaded()
    for which, weight in ((0, 0.5), (2, 0.25)):
        made.launch(index(which), index(0), *GIVEN.on_device(), weight, add=which > 0)
    (_, first), (_, second) = (reference(views()[which]) for which in (0, 2))
    for mine, one, other in zip(gradients(made), first, second, strict=True):
        assert apart(mine, 0.5 * one + 0.25 * other) < CLOSE


def test_a_measurement_has_the_losses_and_no_gradients() -> None:
    made = loaded()
    made.reserve(2)
    made.launch(index(1), index(0), *GIVEN.on_device(), 1.0, add=False)
    before = [array.copy() for array in gradients(made)]
    made.measure(index(1), index(1), *GIVEN.on_device())
    log = made.log.numpy()
    assert log[0] == pytest.approx(log[1], rel=1e-6)
    assert all(map(np.array_equal, gradients(made), before))


def test_exposures_may_change_between_launches() -> None:
    made = loaded()
    made.launch(index(0), index(0), *GIVEN.on_device(), 1.0, add=False)
    bright = made.log.numpy()[0, SQUARES]
    made.exposures.assign(made.exposures.numpy() * np.float32([0.5, 1]))
    made.launch(index(0), index(0), *GIVEN.on_device(), 1.0, add=False)
    assert made.log.numpy()[0, SQUARES] > 2 * bright


def test_what_is_black_leaves_no_trace_of_the_picture_before() -> None:
    plan = replace(PLAN, background=(0.0, 0.0, 0.0))
    made, shot = PicturePass(DEVICE, plan, len(GIVEN.means)), camera(96, 80)
    small, other = (GIVEN._replace(means=0.15 * GIVEN.means + np.float32([x, 0, 0])) for x in (0.25, -0.3))
    view = view_of(np.zeros((4, 80, 96)), shot)
    view.target[:] = 0
    view.target[:, 50:, 70:] = 0.5
    view.exposure[:, 1] = 0
    made.load_views([view])
    for given in (other, small):
        made.launch(index(0), index(0), *given.on_device(), 1.0, add=False)
        row, true = reference(view, given, plan)
        assert made.log.numpy()[0, [IMAGE_LOSS, MASK_LOSS, SQUARES]] == pytest.approx(row, rel=CLOSE)
        for mine, expected in zip(gradients(made), true, strict=True):
            assert apart(mine, expected) < CLOSE


def test_the_generation_tells_when_buffers_were_replaced() -> None:
    made = PicturePass(DEVICE, PLAN, len(GIVEN.means))
    generations = [made.generation]
    for act in (
        lambda: made.load_views(views()),
        lambda: made.load_views(views()),  # the same sizes
        lambda: made.reserve(1),  # it has one
        lambda: made.reserve(9),
        lambda: made.load_views([*views(), view_of(np.zeros((4, 60, 20)), camera(20, 60))]),
        lambda: made.grow(100.0),  # there is room
    ):
        act()
        generations.append(made.generation)
    assert np.diff(generations).tolist() == [1, 0, 0, 1, 1, 0]
    assert made.grow(1e6)
    assert made.generation == generations[-1] + 1
    made.launch(index(3), index(0), *GIVEN.on_device(), 1.0, add=False)
    assert made.log.numpy()[0, PAIRS] > 100


def test_guards_are_counted_and_what_they_hold_back_has_no_gradient() -> None:
    made, factors, features = loaded(), GIVEN.factors.copy(), GIVEN.features.copy()
    middle = np.argsort(np.abs(GIVEN.means).sum(axis=1))[:4]
    factors[middle[0]] *= 1e12
    factors[middle[1]] = np.nan
    features[middle[2], 3] = np.inf
    given = GIVEN._replace(factors=factors, features=features)
    for _ in range(2):
        made.launch(index(0), index(0), *given.on_device(), 1.0, add=False)
    assert made.guard_counts.numpy().tolist() == [4, 2, 0]  # not_finite, footprint_ceiling, gradient_not_finite
    assert not any(gradient[middle[:3]].any() for gradient in gradients(made))
    made.forget_guards()
    made.launch(index(0), index(0), *GIVEN.on_device(), 1e38, add=False)
    assert made.guard_counts.numpy()[0] == 0
    assert made.guard_counts.numpy()[2] > 0
    assert all(np.isfinite(gradient).all() for gradient in gradients(made))
