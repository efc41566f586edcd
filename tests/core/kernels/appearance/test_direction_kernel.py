"""Colours as a camera sees them, against the twin in float64: values, and gradients of all that is learnt."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scas4d_core.engines.torch.gloss import shade
from scas4d_core.kernels.appearance import direction


def scene(count: int) -> dict[str, np.ndarray]:
    """Gaussians with gloss of every direction, some without, some turned; a rough environment."""
    rng = np.random.default_rng(count)
    gloss = rng.normal(size=(count, 3)) * rng.uniform(0.2, 1, (count, 1))
    gloss[::7] = 0
    turns = rng.normal(size=(count, 4))
    environment = rng.normal(size=(direction.ROWS, 3)) + 0.5
    environment[direction.NEARNESS] = (0.3, 0, 0)
    found = {
        "means": rng.normal(size=(count, 3)),
        "gloss": gloss,
        "turns": turns / np.linalg.norm(turns, axis=1, keepdims=True),
        "colours": rng.uniform(-0.05, 1.1, (count, 3)),
        "environment": environment,
        "centre": np.array([0.5, -1, 4]),
    }
    return {name: array.astype(np.float32) for name, array in found.items()}


@pytest.mark.parametrize("count", [1, 5000])
def test_values_and_gradients_agree_with_the_twin(count: int) -> None:
    given = scene(count)
    leaves = {name: torch.tensor(array, dtype=torch.float64) for name, array in given.items()}
    for name in ("gloss", "colours", "environment"):
        leaves[name].requires_grad_()
    expected = shade(**leaves)
    shown = np.full((count, 4), 7, np.float32)
    direction.shade(*given.values(), shown)
    close = np.isclose(shown[:, :3], expected.detach().numpy(), rtol=1e-4, atol=2e-5)
    assert close.all(axis=1).mean() > 0.999  # at a fold of the map, or where it just turns away, rounding decides
    assert (shown[:, 3] == 7).all()
    assert count == 1 or (np.abs(shown[:, :3] - given["colours"]).max(axis=1) > 0.01).mean() > 0.3

    pull = np.random.default_rng(1).normal(size=(count, 4)).astype(np.float32)
    (expected * torch.tensor(pull[:, :3])).sum().backward()
    gloss = np.full((count, 3), np.nan, np.float32)
    environment = direction.shade_backward(*given.values(), pull, gloss)
    for found, name in ((pull[:, :3], "colours"), (gloss, "gloss"), (environment, "environment")):
        truth = leaves[name].grad
        assert truth is not None
        wanted = truth.numpy()
        if name == "environment":
            wanted[direction.MIDDLE] = 0  # x₀ is not learnt
            assert np.abs(found - wanted).max() <= 2e-3 * np.abs(wanted).max() + 1e-6
            continue
        row = np.abs(wanted).max(axis=1, keepdims=True)
        assert (np.abs(found - wanted) <= 2e-3 * row + 1e-4).all(axis=1).mean() > 0.999, name


def test_those_without_gloss_and_those_born_later_keep_their_colours_bit_by_bit() -> None:
    given = scene(64)
    given["gloss"] = given["gloss"][:8]
    shown = np.zeros((64, 4), np.float32)
    direction.shade(*given.values(), shown)
    assert (shown[8:, :3] == given["colours"][8:]).all()
    assert (shown[0, :3] == given["colours"][0]).all()
    assert not (shown[:8, :3] == given["colours"][:8]).all()
    g_shown, g_gloss = np.ones((64, 4), np.float32), np.empty((8, 3), np.float32)
    direction.shade_backward(*given.values(), g_shown, g_gloss)
    assert (g_shown[8:] == 1).all()
    assert (g_gloss[0] == 0).all()


def test_the_task_that_a_gaussian_is_in_changes_nothing_but_the_order_of_sums() -> None:
    given = scene(2 * direction.CHUNK + 5)
    pulls = [np.ones((len(given["means"]), 4), np.float32) for _ in range(2)]
    gradients = [direction.shade_backward(*given.values(), pull, np.empty_like(given["gloss"])) for pull in pulls]
    assert gradients[0].tobytes() == gradients[1].tobytes()
    assert pulls[0].tobytes() == pulls[1].tobytes()
