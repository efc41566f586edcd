"""Laws of one iteration of the update in float64: where the world stands and how it is turned is no business of it.

Adam moves each coordinate by itself, so that only a turn that maps axes to axes leaves its steps alone; under any
other turn the loss stays and its gradients turn along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import permutations, product
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from law_cases import doubles, law, seeds, some_rotation
from scipy.spatial.transform import Rotation

from scas4d_core.engines.engine import AttemptStart, StepScalars, Tables
from scas4d_core.engines.freedom import Freedom
from scas4d_core.engines.plan import ColourPlan, Structure, UpdatePlan
from scas4d_core.engines.torch import deformation
from scas4d_core.engines.torch.engine import TorchEngine
from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy

MOVING, STANDING, NEAREST = 24, 6, 4
CLOSE = 1e-9
"""Relative to the largest of each table."""
PULL = 1e-6
"""Share of the largest gradient of a table from which one counts as more than rounding."""
FLOOR = (0.1, 1.0, 0.2, 0.05)
PLAN = UpdatePlan(
    cameras=("0", "1", "2"), soft_colour=0.01, mask=3.0, axis_length=10.0, neighbour_terms=True, rigidity=4.0,
    isometry=2.0, rotation=4.0, floor=FLOOR, floor_weight=2.0, freedom=Freedom(True, True, True, True, True, True),
    colours=ColourPlan(moving=True, static=True), full_images=True,
)  # fmt: skip
STEP = StepScalars(
    frozen=0, layers=(1.0, 1.0), own=1.0, colour=1.0, gloss=1.0, smooth_gloss=False, rigidity=4.0, sample=0,
    keep_pictures=False,
)  # fmt: skip
WIDTH, HEIGHT = 16, 12


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

    plan: UpdatePlan
    structure: Structure
    state: Gaussians
    views: list[TrainingView]
    start: Tables
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
    labels = np.arange(MOVING) // 12, np.arange(MOVING) // 4
    hierarchy = Hierarchy(np.arange(MOVING), labels, (np.arange(0, 25, 12), np.arange(0, 25, 4)))  # type: ignore[arg-type]
    neighbours = SimpleNamespace(index=nearest, weights=np.exp(-20 * lengths**2), distances=1.1 * lengths)
    structure = Structure(hierarchy, neighbours, means, np.full((len(means), 3), 0.03))  # type: ignore[arg-type]
    views = []
    for index in range(3):
        pose = np.concatenate([some_rotation(seed + index), [[0], [0], [1.5]]], axis=1)
        camera = CameraArrays(pose, np.array([24.0, 24, 8, 6, WIDTH, HEIGHT]), WIDTH, HEIGHT)
        picture = rng.uniform(0, 1, (HEIGHT, WIDTH, 3))
        mask = (rng.uniform(size=(HEIGHT, WIDTH)) > 0.5) * 1.0
        target = np.concatenate([np.moveaxis(picture, -1, 0), mask[None]])
        views.append(TrainingView(str(index), camera, target, np.tile([1.0, 0.0], (4, 1))))
    scale = np.repeat([0.05, 0.02, 0.2, 0.05], [3, 3, 3, 1])
    tables = [scale * rng.normal(size=(size, 10)) for size in (2, 6)]
    start = Tables(tables, np.concatenate(0.02 * rng.normal(size=(3, MOVING, 3)), axis=1))
    return Case(PLAN, structure, state, views, start, np.sort(rng.choice(MOVING, 12, replace=False)))


def placed(case: Case, turn: np.ndarray, shift: np.ndarray) -> Case:
    """The same world and rig elsewhere: x → turn x + shift."""

    def camera(view: TrainingView) -> TrainingView:
        rotation = view.camera.pose[:, :3] @ turn.T
        pose = np.concatenate([rotation, view.camera.pose[:, 3:] - (rotation @ shift)[:, None]], axis=1)
        return replace(view, camera=view.camera._replace(pose=pose))

    normal = turn @ FLOOR[:3]
    floor = (*normal, FLOOR[3] - normal @ shift)
    about = np.roll(Rotation.from_matrix(turn).as_quat(), 1)
    rotations = deformation.quaternion_product(doubles(about).expand(len(case.state), 4), doubles(case.state.rotations))
    state = case.state.replace(
        means=case.state.means @ turn.T + shift, factors=turn @ case.state.factors, rotations=rotations.numpy()
    )
    plan, structure = replace(case.plan, floor=floor), replace(case.structure, roots=state.means)
    start = Tables([along(table, turn, 3) for table in case.start.clusters], along(case.start.deltas, turn, 2))
    return Case(plan, structure, state, [camera(view) for view in case.views], start, case.rows)


def along(table: np.ndarray, turn: np.ndarray, vectors: int) -> np.ndarray:
    """The columns of a table that are vectors, turned: the first so many times three."""
    parts = np.split(table, [3 * k for k in range(1, vectors + 1)], axis=1)
    return np.concatenate([*(part @ turn.T for part in parts[:vectors]), parts[vectors]], axis=1)


@dataclass
class Iteration:
    """Loss and gradients of an iteration, and the parameters that Adam leaves: two layers, own, colours."""

    loss: float
    gradients: list[np.ndarray]
    parameters: list[np.ndarray]


VECTORS = (3, 3, 2)
"""Of the columns of each layer, and of the Gaussians' own."""


def iterate(case: Case, view: int = 0) -> Iteration:
    engine = TorchEngine()
    engine.bind(case.plan, case.structure)
    engine.load_views(case.views, [])
    engine.load_state(case.state)
    engine.set_tables(case.start)
    start = AttemptStart(
        layers=((0.02, 0.008, 0.002), (0.01, 0.002, 0.002)), position=5e-4, rotation=2e-3, scale=1e-3, colour=2e-3,
        static_colour=1e-2, beta1=0.9, beta2=0.999, samples=[case.rows],
    )  # fmt: skip
    engine.begin(start)
    engine.iterate([view], STEP)
    gradients, parameters = engine.gradients(), engine._parameters  # in float64; states and tables are float32
    tables = [
        np.concatenate([values.detach().numpy().reshape(len(p.s), -1) for values in p], axis=1)
        for p in parameters.clusters
    ]
    tables.append(np.concatenate([values.detach().numpy() for values in parameters.deltas], axis=1))
    colours = np.concatenate([parameters.moving_colours.detach().numpy(), parameters.static_colours.detach().numpy()])
    names = ("cluster 0", "cluster 1", "deltas", "colours")
    return Iteration(engine.log().losses[0], [gradients[name] for name in names], [*tables, colours])


def turned(tables: list[np.ndarray], turn: np.ndarray) -> list[np.ndarray]:
    """What has axes is turned; colours have none."""
    return [along(table, turn, count) for table, count in zip(tables, VECTORS, strict=False)] + tables[3:]


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
    case = replace(case, plan=replace(case.plan, cluster_map="published"))
    shifted = iterate(placed(case, np.eye(3), np.ones(3)))
    assert abs(shifted.loss / iterate(case).loss - 1) > 1e-3
