"""The torch update on a toy scene in float64: it finds a known motion, and moves only what it may."""

import dataclasses

import numpy as np
import pytest
import torch
from scas4d_core.engines.torch.arrays import Graph, TermWeights, TorchResult, TorchView
from scas4d_core.engines.torch.update import TorchUpdate

from scas4d_core.cameras import Camera
from scas4d_core.engines.torch import losses
from scas4d_core.engines.torch import rasterizer as twin
from scas4d_core.engines.torch.deformation import quaternion_matrices, quaternion_product, rotation_quaternions
from scas4d_core.engines.torch.rasterizer import CameraParams
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.rates import Rates

MOVING, STANDING = 40, 8
SHIFT = np.array([0.03, 0.02, -0.02])
TURN = 0.1  # tangent of half the angle about y
RATES = Rates(
    layers=((0.01, 0.003, 0.001), (0.005, 0.001, 0.001)), position=1e-4, rotation=5e-4, scale=5e-4, colour=1e-3
)


def look_at(name: str, angle: float) -> Camera:
    c, s = np.cos(angle), np.sin(angle)
    pose = np.eye(4)
    pose[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    pose[2, 3] = 1.5
    return Camera(name, np.array([[60.0, 0, 16], [0, 60, 12], [0, 0, 1]]), pose, 32, 24)


def ball_and_backdrop() -> Gaussians:
    rng = np.random.default_rng(0)
    count = MOVING + STANDING
    means = np.concatenate([rng.normal(0, 0.08, (MOVING, 3)), rng.normal((0, 0, 0.6), 0.3, (STANDING, 3))])
    half = rng.normal(0, 0.3, (count, 3))
    rotations = rotation_quaternions(torch.tensor(half)).numpy()
    return Gaussians(
        means=means.astype(np.float32),
        factors=np.broadcast_to(0.03 * np.eye(3, dtype=np.float32), (count, 3, 3)).copy(),
        rotations=rotations.astype(np.float32),
        opacities=np.full(count, 0.8, np.float32),
        colours=rng.uniform(0.1, 0.9, (count, 3)).astype(np.float32),
        foreground=np.repeat(np.float32([1, 0]), [MOVING, STANDING]),
        ids=np.arange(count),
    )


def moved_truth(before: Gaussians) -> np.ndarray:
    turn = quaternion_matrices(rotation_quaternions(torch.tensor([0, TURN, 0], dtype=torch.float64))).numpy()
    means = before.means.astype(np.float64)
    means[:MOVING] = means[:MOVING] @ turn.T + SHIFT
    return means


def pictures(scene: Gaussians, means: np.ndarray, masks: bool) -> list[TorchView]:
    views = []
    for index, angle in enumerate((-0.6, 0.0, 0.7)):
        camera = look_at(str(index), angle)
        features = np.concatenate([scene.colours, scene.foreground[:, None]], axis=1)
        arrays = (means, scene.factors, scene.opacities, features, np.zeros(4))
        m, f, o, c, b = (torch.tensor(array, dtype=torch.float64) for array in arrays)
        drawn = twin.render(m, f, o, c, CameraParams.of(camera), b).features.numpy()
        views.append(TorchView(camera, drawn[..., :3], drawn[..., 3] if masks else None))
    return views


def toy_update(scene: Gaussians, **changes: object) -> TorchUpdate:
    means = scene.means[:MOVING].astype(np.float64)
    distances = np.linalg.norm(means[:, None] - means, axis=-1)
    neighbours = np.argsort(distances, axis=1)[:, 1:7]
    near = np.take_along_axis(distances, neighbours, axis=1)
    fine = (means[:, 0] > 0) * 2 + (means[:, 1] > 0)
    settings = {
        "moving": np.arange(MOVING),
        "labels": [np.zeros(MOVING, np.int64), fine.astype(np.int64)],
        "graph": Graph(neighbours, np.exp(-200 * near**2), near),
        "first_lengths": np.full((MOVING, 3), 0.03),
        "rates": RATES,
        "dtype": torch.float64,
    }
    return TorchUpdate(**{**settings, **changes})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def solved() -> tuple[Gaussians, np.ndarray, TorchResult]:
    before = ball_and_backdrop()
    truth = moved_truth(before)
    rng = np.random.default_rng(1)
    order = [i % 3 for i in range(60)]
    rows = [rng.permutation(MOVING)[:25] for _ in order]
    return before, truth, toy_update(before).run(before, pictures(before, truth, masks=True), order, rows=rows)


def test_finds_a_rigid_motion(solved: tuple[Gaussians, np.ndarray, TorchResult]) -> None:
    before, truth, after = solved
    assert len(after.losses) == 60
    assert np.mean(after.losses[-6:]) < 0.35 * np.mean(after.losses[:6])
    error = np.linalg.norm(after.gaussians.means - truth, axis=1)[:MOVING]
    start = np.linalg.norm(before.means - truth, axis=1)[:MOVING]
    assert np.median(error) < 0.2 * np.median(start)
    found = np.median(after.turns[:, 2] / after.turns[:, 0])
    assert found == pytest.approx(TURN, abs=0.4 * TURN)


def test_standing_gaussians_keep_all_but_their_colour(solved: tuple[Gaussians, np.ndarray, TorchResult]) -> None:
    before, _, after = solved
    for name in ("means", "factors", "rotations", "opacities", "foreground", "ids"):
        np.testing.assert_array_equal(getattr(after.gaussians, name)[MOVING:], getattr(before, name)[MOVING:])
    assert np.abs(after.gaussians.colours - before.colours).max() > 0
    assert not np.shares_memory(after.gaussians.colours, before.colours)


def test_material_rotation_is_the_turn_after_the_previous(solved: tuple[Gaussians, np.ndarray, TorchResult]) -> None:
    before, _, after = solved
    expected = quaternion_product(torch.tensor(after.turns), torch.tensor(before.rotations[:MOVING])).numpy()
    np.testing.assert_allclose(after.gaussians.rotations[:MOVING], expected, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(after.gaussians.rotations, axis=1), 1, atol=1e-6)


def test_no_iterations_apply_the_start_and_none_is_the_identity(
    solved: tuple[Gaussians, np.ndarray, TorchResult],
) -> None:
    before, truth, after = solved
    views = pictures(before, truth, masks=False)
    same = toy_update(before).run(before, views, [])
    np.testing.assert_allclose(same.gaussians.means, before.means, atol=1e-7)
    again = toy_update(before).run(before, views, [], start=after.layers, deltas=after.deltas)
    assert again.losses == []
    np.testing.assert_allclose(again.gaussians.means, after.gaussians.means, atol=1e-6)
    np.testing.assert_allclose(again.gaussians.factors, after.gaussians.factors, atol=1e-6)


def test_warm_start_begins_lower(solved: tuple[Gaussians, np.ndarray, TorchResult]) -> None:
    before, truth, after = solved
    views = pictures(before, truth, masks=True)
    cold = toy_update(before).run(before, views, [0])
    warm = toy_update(before).run(before, views, [0], start=after.layers)
    assert warm.losses[0] < 0.5 * cold.losses[0]


def test_gaussians_alone_the_published_map_and_float32_lower_the_loss_too() -> None:
    before = ball_and_backdrop()
    views = pictures(before, moved_truth(before), masks=False)
    alone = Rates(layers=(), position=4e-3, rotation=2e-3, scale=1e-3, colour=1e-3, end=0.1)
    for changes in (
        {"labels": [], "rates": alone},
        {"cluster_map": "published"},
        {"dtype": torch.float32, "weights": TermWeights(rigidity=0, isometry=0, rotation=0, scale=0, soft_colour=0)},
    ):
        after = toy_update(before, **changes).run(before, views, [0, 1, 2] * 5)
        assert sum(after.losses[-3:]) < 0.8 * sum(after.losses[:3]), changes


def test_rates_fall_along_half_a_cosine_and_zero_freezes() -> None:
    rates = Rates(layers=(), position=0, rotation=0, scale=0, colour=1e-2, end=0.2)
    assert [rates.factor(i, 11) for i in (0, 5, 10)] == pytest.approx([1, 0.6, 0.2])
    before = ball_and_backdrop()
    after = toy_update(before, labels=[], rates=rates).run(before, pictures(before, moved_truth(before), False), [0, 1])
    np.testing.assert_array_equal(after.gaussians.means, before.means)
    assert np.abs(after.gaussians.colours - before.colours).max() > 1e-3


def test_one_rate_a_layer() -> None:
    with pytest.raises(ValueError, match=r"2 entries for 0 layers"):
        toy_update(ball_and_backdrop(), labels=[])


def test_the_last_rate_is_the_one_asked_for() -> None:
    before = ball_and_backdrop()
    views = pictures(before, moved_truth(before), masks=False)
    rates = dataclasses.replace(RATES, end=1e-9)
    one, two = (toy_update(before, rates=rates).run(before, views, [0] * count) for count in (1, 2))
    np.testing.assert_allclose(two.gaussians.means, one.gaussians.means, atol=1e-7)
    assert np.abs(one.gaussians.means - before.means).max() > 1e-3


@pytest.mark.parametrize("term", ["mask", "rigidity", "isometry", "rotation", "scale", "soft_colour"])
def test_each_term_counts_with_its_weight(term: str, solved: tuple[Gaussians, np.ndarray, TorchResult]) -> None:
    before, truth, after = solved
    views = pictures(before, truth, masks=True)
    # The deltas are stretched so that the scale term has something to say.
    start = {"start": after.layers, "deltas": after.deltas._replace(ds=after.deltas.ds + 0.5)}
    none = dict.fromkeys(("mask", "rigidity", "isometry", "rotation", "scale", "soft_colour"), 0.0)
    # Soft colour only counts once the colours have moved, hence the second of two iterations at a fixed motion.
    rates = Rates(layers=((0, 0, 0), (0, 0, 0)), position=0, rotation=0, scale=0, colour=1e-2)

    def second_loss(**weights: float) -> float:
        update = toy_update(before, rates=rates, weights=TermWeights(**{**none, **weights}))
        return update.run(before, views, [1, 1], **start).losses[1]

    # The first step's colours follow the sign of the gradient alone, which a term without colours does not change.
    state = toy_update(before, rates=rates, weights=TermWeights(**none)).run(before, views, [1], **start)
    update = toy_update(before)
    m, f, q, c = (
        torch.tensor(array, dtype=torch.float64)
        for array in (state.gaussians.means, state.gaussians.factors, state.turns, state.gaussians.colours)
    )
    old = torch.tensor(before.means, dtype=torch.float64)[:MOVING]
    neighbours, w, distances = (torch.tensor(array) for array in update.graph)
    label = torch.tensor(before.foreground, dtype=torch.float64)[:, None]
    opacities = torch.tensor(before.opacities, dtype=torch.float64)
    camera, zero = CameraParams.of(views[1].camera), torch.zeros(1, dtype=torch.float64)
    expected = {
        "mask": lambda: losses.image_loss(
            twin.render(m, f, opacities, label, camera, zero).features, torch.tensor(views[1].mask)[..., None]
        ),
        "rigidity": lambda: losses.rigidity_loss(m[:MOVING], q, old, neighbours, w),
        "isometry": lambda: losses.isometry_loss(m[:MOVING], distances, neighbours, w),
        "rotation": lambda: losses.rotation_loss(q, neighbours, w),
        "scale": lambda: losses.scale_loss(f[:MOVING], torch.tensor(update.first_lengths), update.max_scale),
        "soft_colour": lambda: losses.soft_colour_loss(c, torch.tensor(before.colours, dtype=torch.float64)),
    }[term]().item()
    assert expected > 1e-5
    assert second_loss(**{term: 2.5}) - second_loss() == pytest.approx(2.5 * expected, rel=2e-3)


def test_what_begins_late_does_not_move_before() -> None:
    rates = Rates(layers=(), position=0, rotation=0, scale=0, colour=0, end=0.2, starts=(0.0, 0.5), start=0.75)
    assert [rates.start_of(layer) for layer in range(3)] == [0.0, 0.5, 0.0]
    assert [rates.factor(i, 9, 0.5) for i in (0, 3, 4, 6, 8)] == pytest.approx([0, 0, 1, 0.6, 0.2])
    before = ball_and_backdrop()
    views = pictures(before, moved_truth(before), masks=False)
    late = dataclasses.replace(RATES, start=0.75)
    halfway = toy_update(before, rates=late).run(before, views, [0])
    assert np.abs(halfway.layers[0].r).max() > 1e-4
    for values in halfway.deltas:
        np.testing.assert_array_equal(values, 0)
    after = toy_update(before, rates=late).run(before, views, [0, 1, 2])
    assert np.abs(after.deltas.dp).max() > 1e-5
