"""A small moving scene for the contract of engines: two things move, one stands, five cameras look on."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from scas4d_core.cameras import Camera, Rig
from scas4d_core.engines.choose import WARP_DEVICE
from scas4d_core.engines.cpu.gloss import features_seen
from scas4d_core.engines.cpu.renderer import CpuRenderer
from scas4d_core.engines.engine import AttemptStart, StepScalars, Tables, UpdateEngine
from scas4d_core.engines.exposure import gain_to_exposure
from scas4d_core.engines.freedom import Freedom
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.plan import ColourPlan, Structure, UpdatePlan
from scas4d_core.engines.views import CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.appearance.direction import CELLS, MIDDLE, NEARNESS, ROWS
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.structure.neighbours import Neighbours
from scas4d_core.update.frame_update import structure_of

WIDTH, HEIGHT, FOCAL = 48, 40, 60.0
CLUSTERS = (2, 6)
EVERYTHING = Freedom(True, True, True, True, True, True, True)


@dataclass(frozen=True, eq=False)
class Case:
    """One scene: Θ_{t−1}, its structure, the plan, and views of the frame after it."""

    plan: UpdatePlan
    structure: Structure
    previous: Gaussians
    views: list[TrainingView]
    probes: list[TrainingView]

    @property
    def rows(self) -> np.ndarray:
        return self.structure.hierarchy.rows

    def start(self, **changes: object) -> AttemptStart:
        count = len(self.rows)
        standard = AttemptStart(
            layers=((0.02, 0.02, 0.005),) * len(CLUSTERS), position=0.002, rotation=0.01, scale=0.01,
            colour=0.01, static_colour=0.005, beta1=0.8, beta2=0.95,
            samples=[np.arange(0, count, 2), np.arange(1, count, 2)],
            gains=np.ones((len(self.views), 3), np.float32) if self.plan.camera_gains else None,
        )  # fmt: skip
        return replace(standard, **changes)  # type: ignore[arg-type]


def step(**changes: object) -> StepScalars:
    """An iteration in which everything learns."""
    standard = StepScalars(
        frozen=0, layers=(1.0,) * len(CLUSTERS), own=1.0, colour=1.0, gloss=1.0, smooth_gloss=False, rigidity=4.0,
        sample=0, keep_pictures=False,
    )  # fmt: skip
    return replace(standard, **changes)  # type: ignore[arg-type]


def rig() -> Rig:
    """Five cameras about the origin."""
    cameras = []
    for number in range(5):
        angle = 0.9 * number
        back = np.array([np.sin(angle), -0.35, -np.cos(angle)])
        back /= np.linalg.norm(back)
        right = np.cross([0, 1, 0], -back)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(-back, right), -back])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ (2.2 * back)
        k = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
        cameras.append(Camera(f"c{number}", k, pose, WIDTH, HEIGHT))
    return Rig(tuple(cameras))


def gaussians(seed: int = 5, glossy: bool = False) -> Gaussians:
    """Two blobs that move, and one that stands."""
    rng = np.random.default_rng(seed)
    centres = np.array([[-0.35, 0, 0], [0.35, 0.05, 0.1], [0, 0.35, 0.2]])
    means = np.concatenate([centre + 0.13 * rng.standard_normal((60, 3)) for centre in centres]).astype(np.float32)
    state = Gaussians.of_points(means, 0.05, rng.uniform(0.15, 0.85, (len(means), 3)))
    factors = np.linalg.qr(rng.standard_normal((len(means), 3, 3)))[0] * rng.uniform(0.015, 0.05, (len(means), 1, 3))
    rotations = rng.standard_normal((len(means), 4))
    state = state.replace(
        factors=factors.astype(np.float32),
        rotations=(rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32),
        opacities=rng.uniform(0.3, 0.9, len(means)).astype(np.float32),
        foreground=(np.arange(len(means)) < 120).astype(np.float32),
    )
    if not glossy:
        return state
    normals = means - np.repeat(centres, 60, axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    environment = np.zeros((ROWS, 3), np.float32)
    environment[:CELLS] = 0.3 * rng.standard_normal((CELLS, 3))
    environment[MIDDLE], environment[NEARNESS, 0] = means.mean(axis=0), 0.3
    return state.replace(gloss=(0.4 * normals).astype(np.float32), environment=environment)


def moved(state: Gaussians) -> Gaussians:
    """The state once its first blob has shifted and its second has turned; a little brighter."""
    means = state.means.copy()
    means[:60] += np.float32([0.02, -0.015, 0.01])
    turn = np.array([[np.cos(0.15), 0, np.sin(0.15)], [0, 1, 0], [-np.sin(0.15), 0, np.cos(0.15)]])
    middle = means[60:120].mean(axis=0)
    means[60:120] = (means[60:120] - middle) @ turn.T + middle
    return state.replace(means=means, colours=np.float32(1.04) * state.colours)


def assert_repeated(mine: object, true: object) -> None:
    """Asserts that a computation gave the same result twice: the same bits on a CPU, nearly the same on a GPU.

    On a GPU, the order of atomic sums is not fixed.
    """
    if os.environ.get(WARP_DEVICE, "cpu") == "cpu":
        assert np.array_equal(np.asarray(mine), np.asarray(true))
    else:
        assert apart(np.asarray(mine, np.float64), np.asarray(true, np.float64)) < 0.01


def apart(mine: np.ndarray, true: np.ndarray) -> float:
    """Distance of two arrays, relative to the norm of the second."""
    return float(np.linalg.norm(np.asarray(mine, np.float64) - true) / max(np.linalg.norm(true), 1e-12))


def case(previous: Gaussians | None = None, clusters: tuple[int, ...] = CLUSTERS, **plan: object) -> Case:
    """A scene with a plan of images and all parameters of the deformation, and what ``plan`` adds."""
    glossy = bool(plan.get("gloss"))
    previous = gaussians(glossy=glossy) if previous is None else previous
    cameras = rig()
    standard = UpdatePlan(
        cameras=cameras.names, background=(0.1, 0.2, 0.3), limits=Limits(near=0.2), soft_colour=0.01,
        freedom=EVERYTHING, full_images=True,
    )  # fmt: skip
    made = replace(standard, **plan)  # type: ignore[arg-type]
    sound = previous.replace(means=np.nan_to_num(previous.means))
    hierarchy = build_hierarchy(sound.means, previous.moving, clusters, 4)
    neighbours = Neighbours(sound.means[hierarchy.rows], 6, 20.0) if made.neighbour_terms else None
    structure = structure_of(hierarchy, neighbours, sound)
    renderer, after = CpuRenderer(made.background, limits=made.limits), moved(sound)
    rng, views, probes = np.random.default_rng(1), [], []
    for number, camera in enumerate(cameras.cameras):
        arrays = CameraArrays.of(camera)
        planes = renderer.render(after, arrays, features_seen(after, arrays)).features.copy()
        gain = np.float32([1.0 + 0.06 * (number - 2) * made.camera_gains] * 3)
        exposed = gain_to_exposure(gain)
        planes[:3] = planes[:3] * exposed[:, :1, None] + exposed[:, 1:, None]
        planes[:3] += rng.normal(0, 0.01, planes[:3].shape)
        planes[3] = planes[3] > 0.5
        target = np.ascontiguousarray(planes[: 3 + (made.mask > 0)], np.float32)
        exposure = np.tile(np.float32([1, 0]), (len(target), 1))
        if not made.camera_gains:
            exposure[:3] = np.float32([[1.05, -0.01], [0.97, 0.02], [1.0, 0.0]])
        views.append(TrainingView(camera.name, arrays, target, exposure))
        probes.append(TrainingView(camera.name, arrays, target, exposure))
    return Case(made, structure, previous, views, probes)


def loaded(engine: UpdateEngine, scene: Case, tables: Tables | None = None, **start: object) -> UpdateEngine:
    """An engine that has begun an attempt, from small random parameters unless others are given."""
    engine.bind(scene.plan, scene.structure)
    engine.load_views(scene.views, scene.probes)
    engine.load_state(scene.previous)
    engine.set_tables(random_tables(scene) if tables is None else tables)
    engine.begin(scene.start(**start))
    return engine


def random_tables(scene: Case, size: float = 0.01, seed: int = 2) -> Tables:
    """Small parameters, none of them 0: a deformation in general position."""
    rng, still = np.random.default_rng(seed), Tables.identity(scene.structure.hierarchy)
    for values in (*still.clusters, still.deltas):
        values[:] = size * rng.standard_normal(values.shape)
    return still


COLOURS = ColourPlan(moving=True)
EFFECTS: dict[str, dict[str, object]] = {
    "images alone": {},
    "published map": {"cluster_map": "published"},
    "separate covariance": {"covariance": "separate"},
    "masks": {"mask": 3.0},
    "axis length": {"axis_length": 10.0},
    "rigidity": {"neighbour_terms": True, "rigidity": 4.0},
    "isometry": {"neighbour_terms": True, "isometry": 2.0},
    "rotation": {"neighbour_terms": True, "rotation": 4.0},
    "bending": {"neighbour_terms": True, "rigidity": 4.0, "rigidity_fades": True},
    "floor": {"floor": (0.0, 1.0, 0.0, -0.05), "floor_weight": 2.0},
    "moving colours": {"colours": COLOURS},
    "standing colours": {"colours": ColourPlan(moving=True, static=True)},
    "changing light": {"colours": ColourPlan(moving=True, static=True, changing_light=True)},
    "gloss": {"gloss": True, "colours": COLOURS},
    "camera gains": {"camera_gains": True, "colours": COLOURS},
    "changed pixels": {"full_images": False, "colours": COLOURS},
}
"""Each effect that acts inside an iteration, as its plan has it."""
TOGETHER: dict[str, object] = {
    "mask": 3.0, "axis_length": 10.0, "neighbour_terms": True, "rigidity": 4.0, "isometry": 2.0, "rotation": 4.0,
    "rigidity_fades": True, "floor": (0.0, 1.0, 0.0, -0.05), "floor_weight": 2.0,
    "colours": ColourPlan(moving=True, static=True, changing_light=True), "gloss": True, "camera_gains": True,
}  # fmt: skip
"""All of them at once."""
