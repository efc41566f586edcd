"""Warm start: a motion that goes on is predicted, in proportion to the time."""

from __future__ import annotations

import numpy as np
import pytest
from box_scene import MOVING, make_box, moved
from scipy.spatial.transform import Rotation

from scas4d_core.deformation_cpu import CpuDeformation
from scas4d_core.gaussians import Gaussians
from scas4d_core.hierarchy import build_hierarchy
from scas4d_core.settings import UpdateSettings
from scas4d_core.warm_start import Motion, quaternion_products, rotate, warm_start

AXIS = np.array([0.6, 0.0, 0.8])
CENTRE = np.array([0.5, -0.3, 0.1])
"""A point of the axis, outside the box: its middle goes around it on a circle."""


def about_axis(box: Gaussians, angle: float, rows: slice = slice(0, MOVING)) -> Gaussians:
    """Rows turned about the axis through ``CENTRE``."""
    turn = Rotation.from_rotvec(angle * AXIS)
    means = box.means.astype(np.float64)
    means[rows] = turn.apply(means[rows] - CENTRE) + CENTRE
    return box.replace(means=means.astype(np.float32))


def deformation(clusters: tuple[int, ...]) -> CpuDeformation:
    box = make_box()
    hierarchy = build_hierarchy(box.means, box.moving, clusters, 8)
    return CpuDeformation(hierarchy, None, np.ones((MOVING, 3), np.float32), "centred")


def motion_to(model: CpuDeformation, before: Gaussians, after: Gaussians, seconds: float = 1.0) -> Motion:
    """The motion of a deformation that leaves everything to Δp, as if an update had found it so."""
    model.start(before)
    warm_start(model, None, seconds, UpdateSettings())
    model.deltas[:, :3] = (after.means - before.means)[model.hierarchy.rows]
    model.forward()
    np.testing.assert_allclose(model.means, after.means, atol=1e-6)
    return Motion.of(model, seconds)


def predicted(
    model: CpuDeformation, now: Gaussians, motion: Motion | None, seconds: float, **changes: float
) -> np.ndarray:
    model.start(now)
    warm_start(model, motion, seconds, UpdateSettings(**changes))  # type: ignore[arg-type]
    model.forward()
    return model.means.copy()


@pytest.mark.parametrize("clusters", [(1,), (2, 12, 48)])
def test_a_constant_rotation_about_an_axis_goes_on(clusters: tuple[int, ...]) -> None:
    box, angle = make_box(), 0.15
    states = [about_axis(box, k * angle) for k in range(3)]
    model = deformation(clusters)
    found = predicted(model, states[1], motion_to(model, states[0], states[1]), 1.0)
    step = np.linalg.norm(states[2].means - states[1].means, axis=1)[:MOVING]
    error = np.linalg.norm(found - states[2].means, axis=1)
    assert error[:MOVING].max() < 0.01 * step.min()
    np.testing.assert_array_equal(found[MOVING:], box.means[MOVING:])
    # Axes and material rotations turn along.
    turn = Rotation.from_rotvec(angle * AXIS)
    wanted = np.roll(turn.as_quat(canonical=True), 1)
    assert np.abs(model.turns - wanted).max() < 2e-3
    np.testing.assert_allclose(model.factors[:MOVING], turn.as_matrix() @ box.factors[:MOVING], atol=1e-4)


def test_a_part_that_turns_on_a_turning_body_goes_on() -> None:
    """Each body keeps its own twist: half of the box turns about an axis that the other half does not have."""
    box = make_box()
    near, far = box.means[:MOVING, 0] < 0, box.means[:MOVING, 0] >= 0
    before = box.replace(means=box.means + np.float32([0.5, 0, 0]) * np.pad(far, (0, 64))[:, None])
    rows = np.flatnonzero(near)

    def at(k: int) -> Gaussians:
        turned = about_axis(before, 0.1 * k)
        means = turned.means.copy()
        turn = Rotation.from_rotvec([0, -0.12 * k, 0])
        means[rows] = turn.apply(before.means[rows])
        return turned.replace(means=means.astype(np.float32))

    hierarchy = build_hierarchy(before.means, before.moving, (2, 12, 48), 8)
    model = CpuDeformation(hierarchy, None, np.ones((MOVING, 3), np.float32), "centred")
    found = predicted(model, at(1), motion_to(model, at(0), at(1)), 1.0)
    step = np.linalg.norm(at(2).means - at(1).means, axis=1)[:MOVING]
    assert np.linalg.norm(found - at(2).means, axis=1)[:MOVING].max() < 0.03 * np.median(step)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 2.0])
def test_displacement_is_in_proportion_to_the_time(ratio: float) -> None:
    box, shift = make_box(), np.array([0.02, -0.01, 0.03])
    after = moved(box, turn=Rotation.identity(), shift=shift)
    model = deformation((2, 12, 48))
    motion = motion_to(model, box, after, seconds=0.2)
    found = predicted(model, after, motion, seconds=0.2 * ratio)
    np.testing.assert_allclose(found[:MOVING] - after.means[:MOVING], np.tile(ratio * shift, (MOVING, 1)), atol=2e-6)


def test_a_turn_is_in_proportion_to_the_time() -> None:
    box = make_box()
    model = deformation((1,))
    motion = motion_to(model, box, about_axis(box, 0.1), seconds=1.0)
    predicted(model, about_axis(box, 0.1), motion, seconds=2.0)
    angle = 2 * np.arctan2(np.linalg.norm(model.turns[:, 1:], axis=1), model.turns[:, 0])
    np.testing.assert_allclose(angle, 0.2, rtol=1e-2)


def test_share_zero_and_no_motion_are_the_identity() -> None:
    box = make_box()
    model = deformation((2, 12, 48))
    motion = motion_to(model, box, about_axis(box, 0.1))
    for found in (predicted(model, box, None, 1.0), predicted(model, box, motion, 1.0, warm_start=0.0)):
        np.testing.assert_allclose(found, box.means, atol=1e-7)


def test_quaternions_and_rotations_are_scipys() -> None:
    rng = np.random.default_rng(0)
    a, b = Rotation.random(9, random_state=1), Rotation.random(9, random_state=2)
    product = quaternion_products(*(np.roll(r.as_quat(), 1, axis=1) for r in (a, b)))
    same = np.abs((product * np.roll((a * b).as_quat(), 1, axis=1)).sum(axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-12)
    r, vectors = rng.normal(size=(9, 3)), rng.normal(size=(9, 3))
    turn = Rotation.from_quat(np.concatenate([r, np.ones((9, 1))], axis=1))
    np.testing.assert_allclose(rotate(r, vectors), turn.apply(vectors), atol=1e-12)
