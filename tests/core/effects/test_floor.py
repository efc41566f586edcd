"""The floor term against its twin, and a plane as it comes from the user's world."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scas4d_core.cameras import WorldFrame
from scas4d_core.effects.coherence.floor import floor_inside
from scas4d_core.engines.cpu.floor import floor_term
from scas4d_core.engines.torch.losses import floor_loss

WORLD = WorldFrame(np.array([100.0, -20.0, 5.0]), 0.25)
PLANE = (0.6, 3.0, -1.2, 7.0)
"""Of the user's world; its normal is not of length one."""


def test_inside_a_plane_tells_metres_below_it() -> None:
    points = np.random.default_rng(0).normal(0, 40, (50, 3))
    normal = np.array(PLANE[:3])
    below = (points @ normal + PLANE[3]) / np.linalg.norm(normal) * WORLD.metres_per_unit
    a, b, c, d = floor_inside(PLANE, WORLD)
    np.testing.assert_allclose(WORLD.to_inside(points) @ (a, b, c) + d, below, rtol=0, atol=1e-9)
    assert np.hypot(np.hypot(a, b), c) == pytest.approx(1)


def test_a_plane_without_a_direction_is_refused() -> None:
    with pytest.raises(ValueError, match=r"floor \(0, 0, 0, 1\) has a zero normal; use"):
        floor_inside((0, 0, 0, 1), WORLD)


def test_value_and_gradient_are_those_of_the_twin_and_nothing_else_is_pulled() -> None:
    plane = floor_inside((0, 1, 0, -0.1), WorldFrame(np.zeros(3)))
    means = np.random.default_rng(1).normal(0, 0.3, (40, 3)).astype(np.float32)
    rows = np.arange(5, 40, 2)
    twin = torch.tensor(means[rows].astype(np.float64), requires_grad=True)
    loss = 2.0 * floor_loss(twin, plane)
    loss.backward()  # type: ignore[no-untyped-call]
    given = np.random.default_rng(2).normal(size=means.shape).astype(np.float32)
    gradient = given.copy()
    assert floor_term(plane, means, rows, 2.0, gradient) == pytest.approx(loss.item(), rel=1e-6)
    expected = np.zeros_like(means)
    expected[rows] = twin.grad
    assert 0 < np.count_nonzero(expected[:, 1]) < len(rows)  # some lie above, some below
    np.testing.assert_allclose(gradient - given, expected, atol=1e-6)


def test_nothing_that_moves_is_no_loss() -> None:
    gradient = np.zeros((3, 3), np.float32)
    assert floor_term((0, 1, 0, 5), np.zeros((3, 3), np.float32), np.zeros(0, np.int64), 2.0, gradient) == 0
    assert not gradient.any()
