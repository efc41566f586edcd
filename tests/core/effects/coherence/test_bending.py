"""Bending: patches that turn unlike those around call for it, joints and noise do not; turns are then free."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from box_scene import look_at, make_box, moved, take_frame
from effect_cases import BEFORE, UPDATE, builder, same, updated, updater_of
from effect_cases import RIG as BOX_RIG
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Rig
from scas4d_core.effects.coherence.bending import EFFECT, PATCH, measure_bending, patch_rotations
from scas4d_core.effects.switches import find_contradictions, first_switches, names_on, register_effects
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import StepScalars
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.presets import PRESETS
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings

BOX = make_box()
TURN = Rotation.from_rotvec([0.1, -0.2, 0.15])
SHIFT = np.array([0.1, 0, 0])


def sheet(heights: np.ndarray | float = 0.0, count: int = 70) -> np.ndarray:
    """[count², 3] metres, a sheet of 1 m²; ``heights``: of its columns above the plane."""
    line = np.linspace(0, 1, count)
    x, y = (array.ravel() for array in np.meshgrid(line, line))
    return np.stack([x, y, np.tile(np.broadcast_to(heights, count), count)], axis=1)


def state(means: np.ndarray) -> Gaussians:
    """Gaussians at these places, all of which move."""
    count = len(means)
    arrays = {name: np.repeat(array[:1], count, axis=0) for name, array in BOX.arrays().items()}
    arrays |= {"means": np.ascontiguousarray(means, np.float32), "ids": np.arange(count)}
    return Gaussians(**{**arrays, "foreground": np.ones(count, np.float32)})


def swung(way: float) -> np.ndarray:
    """The sheet with two waves, as high as a twentieth of their length at 1."""
    return sheet(way * 0.025 * np.sin(4 * np.pi * np.linspace(0, 1, 70)))


def hinged(angle: float) -> np.ndarray:
    """The sheet folded along a line."""
    points = sheet()
    beyond = points[:, 0] > 0.5
    line = np.array([0.5, 0, 0])
    points[beyond] = Rotation.from_rotvec([0, angle, 0]).apply(points[beyond] - line) + line
    return points


FLAT = np.random.default_rng(5).uniform(0, 1, (2000, 3)) * [1, 1, 0]
SIZE = 96
RIG = Rig(
    tuple(
        look_at(f"c{k}", [1.3 * np.sin(k * np.pi / 4), 0.45 * (-1) ** k, 1.3 * np.cos(k * np.pi / 4)], 1.6 * SIZE, SIZE)
        for k in range(8)
    )
)


def shown(height: float, turn: Rotation | None = None) -> Gaussians:
    """A sheet of 60 cm in the middle of the rig with two waves, printed in squares."""
    points = FLAT - [0.5, 0.5, 0] + np.outer(height * np.sin(4 * np.pi * FLAT[:, 0]), [0, 0, 1])
    found = state(0.6 * points if turn is None else turn.apply(0.6 * points))
    x, y = (15 * FLAT[:, :2]).astype(int).T
    colours = np.random.default_rng(3).uniform(0.05, 0.95, (15, 15, 3)).astype(np.float32)[x, y]
    return found.replace(colours=colours, factors=np.tile(np.diag(np.float32([0.012, 0.012, 0.004])), (len(x), 1, 1)))


def test_turns_of_patches() -> None:
    patches = np.random.default_rng(0).normal(size=(5, 30, 3))
    turns = Rotation.from_rotvec(np.random.default_rng(1).normal(size=(5, 3))).as_matrix()
    found, rest = patch_rotations(patches, patches @ np.swapaxes(turns, 1, 2) + [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found, turns, atol=1e-12)
    assert (rest < 1e-6).all()
    flat = patches * [1, 1, 0]  # a patch of a surface: its own mirror image is as near
    found, rest = patch_rotations(flat, flat @ np.swapaxes(turns, 1, 2))
    np.testing.assert_allclose(found, turns, atol=1e-12)
    grown = 1.1 * patches @ np.swapaxes(turns, 1, 2)
    found, rest = patch_rotations(patches, grown)
    np.testing.assert_allclose(found, turns, atol=1e-12)
    np.testing.assert_allclose(rest, 0.1, atol=1e-12)


def test_cloth_bends_and_what_is_rigid_or_jointed_does_not() -> None:
    still = state(sheet())
    swings = measure_bending(still, state(TURN.apply(swung(1.0)) + SHIFT))
    assert swings is not None
    assert swings > 2 * EFFECT.on_above
    rng = np.random.default_rng(2)
    for other in (
        TURN.apply(sheet()) + SHIFT,
        hinged(0.3),
        1.05 * sheet(),
        sheet() + rng.normal(0, 0.005, (4900, 3)),
    ):
        found = measure_bending(still, state(other))
        assert found is not None
        assert found < EFFECT.off_below


def test_a_patch_is_a_share_of_the_thing() -> None:
    found = []
    for count in (4000, 30_000):
        flat = np.random.default_rng(1).uniform(0, 1, (count, 3)) * [1, 1, 0]
        swings = flat + np.outer(0.025 * np.sin(4 * np.pi * flat[:, 0]), [0, 0, 1])
        found.append(measure_bending(state(flat), state(swings)))
    few, many = found
    assert few is not None
    assert many is not None
    assert few > 2 * EFFECT.on_above
    assert many == pytest.approx(few, rel=0.2)


def test_too_little_says_nothing_and_what_is_not_finite_is_left_out() -> None:
    still = state(sheet())
    assert measure_bending(still, state(sheet() + 1e-3 * SHIFT)) is None
    few = state(sheet()[:PATCH])
    assert measure_bending(few, few) is None
    assert measure_bending(few.replace(foreground=np.zeros(PATCH, np.float32)), few) is None
    broken = swung(1.0)
    broken[np.random.default_rng(1).permutation(len(broken))[:500]] = np.nan
    found = measure_bending(state(sheet()), state(broken))
    assert found is not None
    assert found > EFFECT.on_above


@pytest.mark.parametrize("pin", ["on", "off"])
def test_a_pin_of_rotation_is_kept(pin: str) -> None:
    settings = Settings.model_validate({"effects": {"rotation": pin}})
    assert EFFECT.refusal(settings) is not None
    both = Settings.model_validate({"effects": {"rotation": pin, "bending": "on"}})
    assert [name for name, *_ in find_contradictions(both)] == ["bending"]
    assert EFFECT.refusal(Settings.model_validate({"update": {"weights": {"rotation": 0}}})) is not None
    assert EFFECT.refusal(Settings()) is None


def test_presets_contradict_nothing() -> None:
    assert first_switches(PRESETS["cloth"], 0)["bending"].on
    assert not first_switches(PRESETS["dynamic3dgs"], 0)["bending"].on
    assert not first_switches(Settings(), 0)["bending"].on


def test_it_leaves_rotation_out_and_lets_rigidity_fall() -> None:
    usual = list(names_on(first_switches(Settings(), 0)))
    built = register_effects(builder(update=UPDATE.model_copy(update={"iterations": 4})), [*usual, "bending"])
    plan = built.plan
    assert (plan.rigidity, plan.isometry, plan.rotation) == (4.0, 6.0, 0.0)
    engine = Weighing()
    updater = updater_of(built, engine)
    views = built.factory.views(take_frame(1, 1.0, moved(BEFORE), BOX_RIG), {})
    for _ in range(2):  # the next update begins with the whole weight
        engine.rigidity.clear()
        updater.run(BEFORE, views, None, 1.0, seed=3)
        np.testing.assert_allclose(engine.rigidity, [2 + 2 * np.cos(np.pi * k / 4) for k in range(4)], atol=1e-12)
    loose = register_effects(builder(), [name for name in usual if name != "rigidity"] + ["bending"])
    assert not loose.plan.rigidity_fades


class Weighing(CpuEngine):
    """Notes the weight of rigidity in each iteration."""

    def __init__(self) -> None:
        self.rigidity: list[float] = []

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        self.rigidity.append(step.rigidity)
        super().iterate(views, step)


def test_its_updates_are_others_and_the_same_again() -> None:
    usual = list(names_on(first_switches(Settings(update=UPDATE), 0)))
    free = updated([*usual, "bending"])
    assert same(free, updated([*usual, "bending"]))
    assert not same(free, updated([name for name in usual if name != "rotation"]))
    assert not same(free, updated(usual))
    assert len(free["means"]) == len(BEFORE)


def followed(mode: str, frames: list[Gaussians]) -> Reconstruction:
    """The sheet after updates to these frames."""
    changes = {"update": {"clusters": (8, 60, 240), "iterations": 60}, "effects": {"bending": mode}}
    first = shown(0.0)
    scene = Reconstruction.start(
        RIG, take_frame(0, 0, first, RIG), Settings.model_validate(changes), static=StaticResult(first, {}, [])
    )
    for index, now in enumerate(frames, 1):
        scene.step(take_frame(index, index / 30, now, RIG))
    return scene


@pytest.mark.slow
def test_a_sheet_that_swings_switches_it_on_and_is_met_better() -> None:
    swings = [shown(height) for height in (0.04, 0.0, 0.04)]
    auto, off = followed("auto", swings), followed("off", swings)
    switch = auto._prepared.carried.switches["bending"]
    assert switch.on
    assert switch.since == 1
    assert switch.text.endswith("per frame relative to each other")
    error = [np.abs(scene.history.newest.means - swings[-1].means).mean() for scene in (auto, off)]
    assert error[0] < 0.85 * error[1]
    again = followed("auto", swings)
    assert same(auto.history.newest.arrays(), again.history.newest.arrays())


@pytest.mark.slow
def test_a_sheet_that_turns_leaves_it_off_with_the_same_bits() -> None:
    turns = [shown(0.0, Rotation.from_rotvec([0.03 * index, 0.08 * index, 0])) for index in range(1, 3)]
    auto, off = followed("auto", turns), followed("off", turns)
    switch = auto._prepared.carried.switches["bending"]
    assert not switch.on
    assert switch.text != ""
    assert same(auto.history.newest.arrays(), off.history.newest.arrays())
