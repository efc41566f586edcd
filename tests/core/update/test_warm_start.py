"""Warm start: a motion that goes on is predicted, in proportion to the time."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import MOVING, make_box, moved
from scipy.spatial.transform import Rotation

from scas4d_core.engines.cpu.deformation import CpuDeformation
from scas4d_core.engines.engine import Tables
from scas4d_core.gaussians import Gaussians, quaternion_products
from scas4d_core.structure.hierarchy import build_hierarchy
from scas4d_core.update.warm_start import Motion, rotate, warm_start
from studies.constants import varied

AXIS = np.array([0.6, 0.0, 0.8])
CENTRE = np.array([0.5, -0.3, 0.1])
"""A point of the axis, outside the box: its middle goes around it on a circle."""


def turned(points: np.ndarray, angle: float, axis: np.ndarray = AXIS, centre: np.ndarray = CENTRE) -> np.ndarray:
    """[M, 3] turned about an axis through a point."""
    result: np.ndarray = Rotation.from_rotvec(angle * axis).apply(points - centre) + centre
    return result


def deformation(clusters: tuple[int, ...], before: Gaussians) -> CpuDeformation:
    hierarchy = build_hierarchy(before.means, before.moving, clusters, 8)
    return CpuDeformation(hierarchy, None, np.ones((MOVING, 3), np.float32), "centred")


def set_turn(
    model: CpuDeformation, layer: int, which: np.ndarray, angle: float, axis: np.ndarray, centre: np.ndarray
) -> None:
    """Clusters ``which`` of a layer turn about an axis through a point (space as the layers above leave it)."""
    model.forward()
    pivots = model._tables[model._offsets[layer] :][: model.hierarchy.sizes[layer], 13:16].astype(np.float64)
    values = model.clusters[layer]
    values[which, :3] = np.tan(angle / 2) * axis
    values[which, 3:6] = (turned(pivots, angle, axis, centre) - pivots)[which]


def begin(model: CpuDeformation, before: Gaussians) -> None:
    model.start(before)
    warmed(model, None, 1.0)


def warmed(model: CpuDeformation, motion: Motion | None, seconds: float) -> None:
    tables = warm_start(model.hierarchy, motion, seconds, 0.0)
    for values, given in zip([*model.clusters, model.deltas], [*tables.clusters, tables.deltas], strict=True):
        values[:] = given


def motion_of(model: CpuDeformation, seconds: float) -> Motion:
    return Motion.of(Tables(model.clusters, model.deltas), model.hierarchy, seconds)


def predicted(model: CpuDeformation, now: Gaussians, motion: Motion | None, seconds: float) -> np.ndarray:
    model.start(now)
    warmed(model, motion, seconds)
    model.forward()
    return model.means.copy()


def every(model: CpuDeformation, layer: int) -> np.ndarray:
    return np.ones(model.hierarchy.sizes[layer], bool)


@pytest.mark.parametrize(("clusters", "layer"), [((1,), 0), ((2, 12, 48), 0), ((2, 12, 48), 2)])
def test_a_constant_rotation_about_an_axis_goes_on(clusters: tuple[int, ...], layer: int) -> None:
    """Whichever layer found it."""
    box, angle = make_box(), 0.15
    model = deformation(clusters, box)
    begin(model, box)
    set_turn(model, layer, every(model, layer), angle, AXIS, CENTRE)
    model.forward()
    moving = slice(0, MOVING)
    np.testing.assert_allclose(model.means[moving], turned(box.means[moving], angle), atol=1e-6)
    now = box.replace(means=model.means.copy(), factors=model.factors.copy())
    found = predicted(model, now, motion_of(model, 1.0), 1.0)
    truth = turned(box.means[moving], 2 * angle)
    step = np.linalg.norm(truth - now.means[moving], axis=1)
    assert np.linalg.norm(found[moving] - truth, axis=1).max() < 0.01 * step.min()
    np.testing.assert_array_equal(found[MOVING:], box.means[MOVING:])
    # Axes and material rotations turn along.
    turn = Rotation.from_rotvec(angle * AXIS)
    assert np.abs(model.turns - np.roll(turn.as_quat(canonical=True), 1)).max() < 2e-3
    np.testing.assert_allclose(model.factors[moving], turn.as_matrix() @ now.factors[moving], atol=1e-4)


def test_a_part_that_turns_on_a_turning_body_goes_on() -> None:
    """Half of the box also turns about an axis that is fixed in the body, which carries that axis along."""
    box = make_box()
    far = np.pad(box.means[:MOVING, 0] >= 0, (0, 64))
    before = box.replace(means=box.means + np.float32([0.5, 0, 0]) * far[:, None])
    model = deformation((2, 12, 48), before)
    body, part, own = 0.2, 0.25, np.array([0.0, 1.0, 0.0])
    joint = np.array([-0.2, 0.0, 0.0])

    def at(k: int) -> np.ndarray:
        points = before.means[:MOVING].astype(np.float64)
        inner = turned(points, part * k, own, joint)
        return turned(np.where(far[:MOVING, None], points, inner), body * k)

    begin(model, before)
    set_turn(model, 0, every(model, 0), body, AXIS, CENTRE)
    near = ~far[model.hierarchy.rows][model.hierarchy.starts[1][:-1]]
    turn = Rotation.from_rotvec(body * AXIS)
    set_turn(model, 1, near, part, turn.apply(own), turned(joint, body))
    model.forward()
    np.testing.assert_allclose(model.means[:MOVING], at(1), atol=1e-6)
    found = predicted(model, before.replace(means=model.means.copy()), motion_of(model, 1.0), 1.0)
    step = np.linalg.norm(at(2) - at(1), axis=1)
    assert np.linalg.norm(found[:MOVING] - at(2), axis=1).max() < 0.03 * np.median(step)


@pytest.mark.parametrize("by_deltas", [False, True])
@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_displacement_is_in_proportion_to_the_time(ratio: float, by_deltas: bool) -> None:
    """Also what the Gaussians of a cluster did in common on their own."""
    box, shift = make_box(), np.array([0.02, -0.01, 0.03])
    after = moved(box, turn=Rotation.identity(), shift=shift)
    model = deformation((2, 12, 48), box)
    begin(model, box)
    if by_deltas:
        model.deltas[:, :3] = shift
    else:
        model.clusters[1][:, 3:6] = shift
    model.forward()
    found = predicted(model, after, motion_of(model, 0.2), seconds=0.2 * ratio)
    np.testing.assert_allclose(found[:MOVING] - after.means[:MOVING], np.tile(ratio * shift, (MOVING, 1)), atol=2e-6)


def test_a_turn_is_in_proportion_to_the_time() -> None:
    box = make_box()
    model = deformation((1,), box)
    begin(model, box)
    set_turn(model, 0, every(model, 0), 0.1, AXIS, CENTRE)
    model.forward()
    predicted(model, box.replace(means=model.means.copy()), motion_of(model, 1.0), seconds=2.0)
    angle = 2 * np.arctan2(np.linalg.norm(model.turns[:, 1:], axis=1), model.turns[:, 0])
    np.testing.assert_allclose(angle, 0.2, rtol=1e-2)


def test_share_zero_and_no_motion_are_the_identity() -> None:
    box = make_box()
    model = deformation((2, 12, 48), box)
    begin(model, box)
    set_turn(model, 0, every(model, 0), 0.1, AXIS, CENTRE)
    model.deltas[:] = 0.01
    model.forward()
    motion = motion_of(model, 1.0)
    with varied("scas4d_core.update.warm_start.WARM_START", 0.0):
        nothing = predicted(model, box, motion, 1.0)
    for found in (nothing, predicted(model, box, None, 1.0)):
        np.testing.assert_allclose(found, box.means, atol=1e-7)
        np.testing.assert_allclose(model.factors, box.factors, atol=1e-7)


def test_quaternions_and_rotations_are_scipys() -> None:
    rng = np.random.default_rng(0)
    a, b = Rotation.random(9, random_state=1), Rotation.random(9, random_state=2)
    product = quaternion_products(*(np.roll(r.as_quat(), 1, axis=1) for r in (a, b)))
    same = np.abs((product * np.roll((a * b).as_quat(), 1, axis=1)).sum(axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-12)
    r, vectors = rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    turn = Rotation.from_quat(np.concatenate([r, np.ones((9, 1))], axis=1))
    np.testing.assert_allclose(rotate(r, vectors), turn.apply(vectors), atol=1e-12)
