"""Laws of one iteration of the update in float64: where the world stands and how it is turned is no business of it.

Adam moves each coordinate by itself, so that only a turn that maps axes to axes leaves its steps alone; under any
other turn the loss stays and its gradients turn along.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from law_cases import doubles, law, seeds, some_rotation
from scas4d_core.engines.torch.arrays import ClusterArrays, DeltaArrays, Graph, TermWeights, TorchView
from scas4d_core.engines.torch.update import TorchUpdate
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera
from scas4d_core.effects.coherence.floor import FloorPart
from scas4d_core.engines.torch import deformation
from scas4d_core.engines.torch import update as update_torch
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.rates import Rates

MOVING, STANDING, NEAREST = 24, 6, 4
CLOSE = 1e-9
"""Relative to the largest of each table."""
PULL = 1e-6
"""Share of the largest gradient of a table from which one counts as more than rounding."""
RATES = Rates(
    layers=((0.02, 0.008, 0.002), (0.01, 0.002, 0.002)), position=5e-4, rotation=2e-3, scale=1e-3, colour=2e-3,
    colour_standing=1e-2,
)  # fmt: skip
FLOOR = (0.1, 1.0, 0.2, 0.05)


def floor_twin(plane: tuple[float, ...]) -> Callable[[torch.Tensor], torch.Tensor | None]:
    """The term of a floor with weight 2."""
    return FloorPart(plane, np.arange(MOVING), 2.0).twin  # type: ignore[arg-type]


AXES = [
    np.array(signs)[:, None] * np.eye(3)[list(order)]
    for order in permutations(range(3))
    for signs in product((1, -1), repeat=3)
]
AXES = [matrix for matrix in AXES if np.linalg.det(matrix) > 0]
"""The 24 rotations that map axes to axes."""


@dataclass(frozen=True)
class Case:
    """Θ_{t−1} in float64, the pictures of three cameras, and where the iteration starts."""

    update: TorchUpdate
    state: Gaussians
    views: list[TorchView]
    start: list[ClusterArrays]
    deltas: DeltaArrays
    rows: np.ndarray


def some_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    count = MOVING + STANDING
    means = np.concatenate([rng.normal(0, 0.15, (MOVING, 3)), rng.normal(0, 0.4, (STANDING, 3))])
    state = Gaussians(
        means=means,
        factors=Rotation.random(count, random_state=seed % 2**32).as_matrix() * rng.uniform(0.02, 0.08, (count, 1, 3)),
        rotations=np.roll(Rotation.random(count, random_state=seed % 2**32).as_quat(), 1, axis=1),
        opacities=rng.uniform(0.3, 0.95, count),
        colours=rng.uniform(0, 1, (count, 3)),
        foreground=np.repeat([0.95, 0.05], [MOVING, STANDING]),
        ids=np.arange(count),
    )  # type: ignore[arg-type]
    distances = np.linalg.norm(means[:MOVING, None] - means[:MOVING], axis=-1)
    nearest = np.argsort(distances, axis=1)[:, 1 : NEAREST + 1]
    lengths = np.take_along_axis(distances, nearest, axis=1)
    update = TorchUpdate(
        moving=np.arange(MOVING),
        labels=[np.arange(MOVING) // 12, np.arange(MOVING) // 4],
        graph=Graph(nearest, np.exp(-20 * lengths**2), 1.1 * lengths),
        first_lengths=np.full((MOVING, 3), 0.03),
        rates=RATES,
        weights=TermWeights(),
        terms=(floor_twin(FLOOR),),
        dtype=torch.float64,
    )
    views = []
    for index in range(3):
        pose = np.eye(4)
        pose[:3, :3], pose[2, 3] = some_rotation(seed + index), 1.5
        camera = Camera(str(index), np.array([[24.0, 0, 8], [0, 24, 6], [0, 0, 1]]), pose, 16, 12)
        views.append(TorchView(camera, rng.uniform(0, 1, (12, 16, 3)), (rng.uniform(size=(12, 16)) > 0.5) * 1.0))
    scale = np.repeat([0.05, 0.02, 0.2, 0.05], [3, 3, 3, 1])
    tables = [scale * rng.normal(size=(size, 10)) for size in (2, 6)]
    start = [ClusterArrays(p[:, :3], p[:, 3:6], p[:, 6:9], p[:, 9]) for p in tables]
    deltas = DeltaArrays(*(0.02 * rng.normal(size=(3, MOVING, 3))))
    return Case(update, state, views, start, deltas, np.sort(rng.choice(MOVING, 12, replace=False)))


def placed(case: Case, turn: np.ndarray, shift: np.ndarray) -> Case:
    """The same world and rig elsewhere: x → turn x + shift."""

    def camera(view: TorchView) -> TorchView:
        pose = view.camera.world_to_camera.copy()
        pose[:3, :3] = view.camera.rotation @ turn.T
        pose[:3, 3] = view.camera.translation - pose[:3, :3] @ shift
        return view._replace(camera=replace(view.camera, world_to_camera=pose))

    normal = turn @ FLOOR[:3]
    floor = (*normal, FLOOR[3] - normal @ shift)
    about = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
    rotations = deformation.quaternion_product(doubles(about).expand(len(case.state), 4), doubles(case.state.rotations))
    state = case.state.replace(
        means=case.state.means @ turn.T + shift, factors=turn @ case.state.factors, rotations=rotations.numpy()
    )
    start = [ClusterArrays(r @ turn.T, t @ turn.T, c @ turn.T, s) for r, t, c, s in case.start]
    dp, dr, ds = case.deltas
    return Case(
        replace(case.update, terms=(floor_twin(floor),)), state, [camera(view) for view in case.views], start,
        DeltaArrays(dp @ turn.T, dr @ turn.T, ds), case.rows,
    )  # fmt: skip


@dataclass
class Iteration:
    """Loss and gradients of an iteration, and the parameters that Adam leaves; vectors first, then what has no axes."""

    loss: float
    gradients: list[np.ndarray]
    parameters: list[np.ndarray]


VECTORS = 3


def iterate(case: Case, view: int = 0) -> Iteration:
    scene = update_torch._Scene.of(case.update, case.state, case.views, case.start, case.deltas)
    groups = scene.parameter_groups(case.update.rates)
    optimizer = torch.optim.Adam(groups, eps=update_torch.ADAM_EPSILON)
    loss = scene.loss(view, torch.tensor(case.rows))
    loss.backward()
    vectors = [tensor for _, params in scene.layers for tensor in params[:VECTORS]] + list(scene.deltas[:2])
    others = [params.s for _, params in scene.layers] + [scene.deltas.ds, *scene.free_colours]
    tensors = [*vectors, *others]
    gradients = [tensor.grad.numpy().copy() for tensor in tensors]
    optimizer.step()
    return Iteration(loss.item(), gradients, [tensor.detach().numpy() for tensor in tensors])


def turned(tables: list[np.ndarray], turn: np.ndarray) -> list[np.ndarray]:
    """What has axes is turned: three tables a layer, and Δp, Δr."""
    count = 2 * VECTORS + 2
    return [table @ turn.T for table in tables[:count]] + tables[count:]


def assert_tables(found: list[np.ndarray], wanted: list[np.ndarray]) -> None:
    for index, (a, b) in enumerate(zip(found, wanted, strict=True)):
        assert np.abs(b).max() > 0, index
        np.testing.assert_allclose(a, b, rtol=0, atol=CLOSE * np.abs(b).max(), err_msg=f"table {index}")


@law(10)
@given(seeds, st.floats(0, 10))
def test_loss_and_gradients_turn_and_shift_along(seed: int, distance: float) -> None:
    case, turn = some_case(seed), some_rotation(seed + 7)
    shift = distance * np.random.default_rng(seed).normal(size=3)
    plain, other = iterate(case), iterate(placed(case, turn, shift))
    assert other.loss == pytest.approx(plain.loss, rel=CLOSE)
    assert_tables(other.gradients, turned(plain.gradients, turn))


@law(10)
@given(seeds, st.sampled_from(AXES), st.floats(0, 10))
def test_a_whole_iteration_goes_along_where_axes_go_to_axes(seed: int, turn: np.ndarray, distance: float) -> None:
    case = some_case(seed)
    shift = distance * np.random.default_rng(seed).normal(size=3)
    plain, other = iterate(case), iterate(placed(case, turn, shift))
    assert other.loss == pytest.approx(plain.loss, rel=CLOSE)
    # The first step is of full size whatever the gradient: where that is rounding alone, so is the way.
    pulled = [np.abs(table) > PULL * np.abs(table).max() for table in turned(plain.gradients, turn)]
    assert np.mean([mask.mean() for mask in pulled]) > 0.8
    found, wanted = other.parameters, turned(plain.parameters, turn)
    assert_tables(*([table * mask for table, mask in zip(tables, pulled, strict=True)] for tables in (found, wanted)))


def test_the_published_map_does_not_go_along() -> None:
    """What the laws are there to find: it scales about the world's origin."""
    case = some_case(1)
    case = replace(case, update=replace(case.update, cluster_map="published"))
    shifted = iterate(placed(case, np.eye(3), np.ones(3)))
    assert abs(shifted.loss / iterate(case).loss - 1) > 1e-3
