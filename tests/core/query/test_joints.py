"""Joints between parts, on bodies whose joints are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import WorldFrame
from scas4d_core.gaussians import UNBORN, Gaussians
from scas4d_core.query.joints import find_joints, joints
from scas4d_core.query.part_motion import PartTrack
from scas4d_core.storage.history import History

FRAMES = 20
EXTENT = 3.0
TIME = np.linspace(0, 1, FRAMES)


def box(centre, size, seed=0):
    """Returns 120 points in a box."""
    return centre + (np.random.default_rng(seed).random((120, 3)) - 0.5) * size


def turned(vectors, centre=(0, 0, 0), shifts=None):
    """Returns rigid motions [T, 4, 4] that rotate by vectors [T, 3] about a centre, and then move by shifts [T, 3]."""
    motions = np.tile(np.eye(4), (len(vectors), 1, 1))
    motions[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix()
    motions[:, :3, 3] = centre - motions[:, :3, :3] @ np.asarray(centre, float)
    if shifts is not None:
        motions[:, :3, 3] += shifts
    return motions


def track(part, motions, points):
    return PartTrack(part, motions, np.zeros(len(motions)), points, np.ones(len(points)))


def still(points):
    return track(-1, np.tile(np.eye(4), (FRAMES, 1, 1)), points)


def wobbling(size=0.8):
    """Returns a motion [T, 4, 4] that turns about several axes and moves along a curve."""
    vectors = size * np.stack([np.sin(5 * TIME), 1 - np.cos(4 * TIME), np.sin(3 * TIME + 1) - np.sin(1)], axis=1)
    return turned(vectors, shifts=np.stack([np.sin(4 * TIME), TIME**2, np.sin(7 * TIME)], axis=1))


def noisy(motions, seed):
    rng = np.random.default_rng(seed)
    noise = turned(rng.normal(0, 0.002, (FRAMES, 3)), shifts=rng.normal(0, 0.002, (FRAMES, 3)))
    return motions @ noise


ARM, HINGE, AXIS = box([1, 0, 0], [2, 0.2, 0.2]), np.array([2.0, 0, 0]), np.array([0, 0.6, 0.8])
FORE = box([2.5, 0, 0], [1, 0.2, 0.2], seed=1)


@pytest.mark.parametrize("seed", [None, 0, 1])
def test_a_hinge_on_a_moving_part_has_its_axis_centre_and_angles(seed):
    angles = 1.2 * np.sin(5 * TIME)
    parent = wobbling()
    child = parent @ turned(angles[:, None] * AXIS, HINGE)
    if seed is not None:
        parent, child = noisy(parent, seed), noisy(child, seed + 10)
    (joint,) = find_joints([track(4, parent, ARM), track(7, child, FORE)], EXTENT)
    assert (joint.kind, joint.parent, joint.child) == ("revolute", 4, 7)
    tight = 1e-6 if seed is None else 0.03
    np.testing.assert_allclose(joint.values, angles, atol=tight)  # the largest angle is positive
    np.testing.assert_allclose(joint.axes, parent[:, :3, :3] @ AXIS, atol=tight)
    across = joint.centres - (parent[:, :3, :3] @ HINGE + parent[:, :3, 3])
    along = np.einsum("ti,ti->t", across, joint.axes)
    np.testing.assert_allclose(across, along[:, None] * joint.axes, atol=tight)  # on the axis
    assert (np.abs(along) < 0.3).all()  # where the parts meet
    assert joint.error < (1e-6 if seed is None else 0.02)


def test_the_parent_is_static_or_the_larger_part_whatever_the_order():
    opened = turned(TIME[:, None] * AXIS, HINGE)
    for first, second in (("wall", "leaf"), ("leaf", "wall")):
        given = {"wall": still(ARM), "leaf": track(0, opened, FORE)}
        (joint,) = find_joints([given[first], given[second]], EXTENT)
        assert (joint.parent, joint.child) == (-1, 0)
        turn = Rotation.from_rotvec(joint.values[:, None] * joint.axes).as_matrix()
        np.testing.assert_allclose(turn, opened[:, :3, :3], atol=1e-6)
        (joint,) = find_joints([track(1, opened, FORE[:60]), track(0, still(ARM).motions, ARM)], EXTENT)
        assert (joint.parent, joint.child) == (0, 1)
        (joint,) = find_joints([track(1, opened, FORE), track(0, still(ARM).motions, ARM[:60])], EXTENT)
        assert (joint.parent, joint.child) == (1, 0)
        turn = Rotation.from_rotvec(joint.values[:, None] * joint.axes).as_matrix()
        np.testing.assert_allclose(turn, np.linalg.inv(opened)[:, :3, :3], atol=1e-6)


def test_a_slider_has_distances():
    along = np.array([1.0, 0, 0])
    parent = wobbling()
    moved = 0.5 * TIME**2
    child = parent @ turned(np.zeros((FRAMES, 3)), shifts=moved[:, None] * along)
    (joint,) = find_joints([track(0, parent, ARM), track(1, child, FORE[:60])], EXTENT)
    assert joint.kind == "prismatic"
    np.testing.assert_allclose(joint.values, moved, atol=1e-6)
    np.testing.assert_allclose(joint.axes, parent[:, :3, :3] @ along, atol=1e-6)


def test_a_ball_joint_has_its_centre_and_the_rotation_of_the_child():
    vectors = np.stack([np.sin(5 * TIME), 0.5 * np.sin(8 * TIME), TIME], axis=1)
    parent = wobbling(0.4)
    child = parent @ turned(vectors, HINGE)
    (joint,) = find_joints([track(0, parent, ARM), track(1, child, FORE[:60])], EXTENT)
    assert joint.kind == "spherical"
    np.testing.assert_allclose(joint.centres, parent[:, :3, :3] @ HINGE + parent[:, :3, 3], atol=1e-6)
    turns = Rotation.from_rotvec(joint.values[:, None] * joint.axes).as_matrix()
    relative = child[:, :3, :3] @ np.swapaxes(parent[:, :3, :3], 1, 2)
    np.testing.assert_allclose(turns, relative, atol=1e-6)


def test_independent_bodies_and_bodies_that_do_not_touch_have_no_joint():
    assert find_joints([track(0, wobbling(), ARM), track(1, wobbling()[::-1] @ wobbling(0.3), FORE)], EXTENT) == []
    far = FORE + np.array([0, 2, 0])
    swinging = turned(TIME[:, None] * AXIS, HINGE)
    assert find_joints([still(ARM), track(0, swinging, far)], EXTENT) == []
    assert find_joints([still(ARM), track(0, turned(np.zeros((FRAMES, 3))), FORE)], EXTENT) == []  # nothing moves
    assert find_joints([], EXTENT) == []


def test_parallel_hinges_form_a_chain():
    """All three pairs of parts move about parallel axes, but only neighbours touch."""
    upper, middle, lower = (
        box([0.5, 0, 0], [1, 0.1, 0.1]),
        box([1.5, 0, 0], [1, 0.1, 0.1]),
        box([2.5, 0, 0], [1, 0.1, 0.1]),
    )
    about = np.array([0, 0, 1.0])
    first = turned(0.9 * np.sin(4 * TIME)[:, None] * about, [0, 0, 0])
    second = first @ turned(0.9 * np.sin(7 * TIME)[:, None] * about, [1, 0, 0])
    third = second @ turned(0.9 * np.sin(2 * TIME)[:, None] * about, [2, 0, 0])
    wall = box([-0.5, 0, 0], [1, 1, 1])
    found = find_joints([track(2, third, lower), track(0, first, upper), still(wall), track(1, second, middle)], EXTENT)
    assert [(joint.parent, joint.child) for joint in found] == [(-1, 0), (0, 1), (1, 2)]
    assert {joint.kind for joint in found} == {"revolute"}


def test_a_wheel_turns_on_and_on():
    angles = 9 * TIME
    wheel = box([0, 0, 0.2], [1, 1, 0.2])
    (joint,) = find_joints(
        [still(box([0, 0, 0], [0.2, 1.4, 0.2])), track(0, turned(angles[:, None] * [0, 0, 1]), wheel)], 1
    )
    np.testing.assert_allclose(joint.values, angles, atol=1e-6)
    found = joint.rows([10, 12, 14]).values  # from 4.7 radians on
    np.testing.assert_allclose(found, angles[[10, 12, 14]] - 2 * np.pi, atol=1e-6)
    far_apart = joint.rows([0, 9, 18]).values  # turns of 4.3 radians look like turns of −2
    np.testing.assert_allclose(far_apart, [0, 9 * 9 / 19 - 2 * np.pi, 2 * (9 * 9 / 19 - 2 * np.pi)], atol=1e-6)


def test_frames_in_which_a_part_is_absent_are_nan():
    opened = turned(TIME[:, None] * AXIS, HINGE)
    opened[:3] = np.nan
    opened[7] = np.nan
    (joint,) = find_joints([still(ARM), track(0, opened, FORE)], EXTENT)
    absent = np.isnan(joint.values)
    assert np.flatnonzero(absent).tolist() == [0, 1, 2, 7]
    assert (np.isnan(joint.axes).all(axis=1) == absent).all()
    assert (np.isnan(joint.centres).all(axis=1) == absent).all()
    np.testing.assert_allclose(joint.values[~absent], TIME[~absent] - TIME[3], atol=1e-6)
    mostly = np.full_like(opened, np.nan)
    mostly[:3] = turned(TIME[:3, None] * AXIS, HINGE)
    assert find_joints([still(ARM), track(0, mostly, FORE)], EXTENT) == []  # too few frames


def test_joints_of_a_history_are_in_the_users_world_and_frames():
    world = WorldFrame(np.array([10.0, 20, 30]), metres_per_unit=0.5)
    points = np.concatenate([ARM, FORE])
    labels = np.repeat([-1, 0], 120)
    state = Gaussians.of_points(points, radius=0.05)
    history = History()
    for frame in range(FRAMES):
        turn = Rotation.from_rotvec(TIME[frame] * AXIS)
        means = np.concatenate([ARM, turn.apply(FORE - HINGE) + HINGE])
        rotations = np.where(labels[:, None] < 0, [1, 0, 0, 0], np.roll(turn.as_quat(), 1)).astype(np.float32)
        history.append(2 * frame, frame / 30, state.replace(means=means.astype(np.float32), rotations=rotations))
    (joint,) = joints(history, labels, world, [4, 6, 20])
    np.testing.assert_allclose(joint.values, TIME[[2, 3, 10]], atol=1e-4)
    offset = joint.centres[0] - world.to_user(HINGE)
    np.testing.assert_allclose(np.cross(offset, AXIS), 0, atol=1e-3)
    assert joint.error < 1e-3
    (whole,) = joints(history, labels, world, history.indices)
    assert (joint.error, joint.kind, joint.parent) == (whole.error, whole.kind, whole.parent)  # whatever is asked for
    for name in ("values", "axes", "centres"):
        np.testing.assert_array_equal(getattr(joint, name), getattr(whole, name)[[2, 3, 10]])


def test_a_scene_without_size_weights_or_finite_points_has_no_joints_or_the_usual_ones():
    opened = track(0, turned(TIME[:, None] * AXIS, HINGE), FORE)
    assert find_joints([still(ARM), opened], 0.0) == []
    assert find_joints([still(ARM), replace(opened, points=np.full_like(FORE, np.nan))], EXTENT) == []
    (usual,) = find_joints([still(ARM), opened], EXTENT)
    (unweighted,) = find_joints([still(ARM), replace(opened, weights=np.zeros(len(FORE)))], EXTENT)
    np.testing.assert_array_equal(usual.axes, unweighted.axes)


def test_the_motion_before_a_part_is_born_is_no_evidence():
    """A part whose Gaussians are born in frame 6 has a joint from then on."""
    labels = np.repeat([-1, 0], 120)
    history = History()
    for frame in range(FRAMES):
        means = ARM
        ids = np.where(np.arange(240) < 120, np.arange(240), UNBORN if frame == 6 else np.arange(240))
        if frame >= 6:
            turn = Rotation.from_rotvec((TIME[frame] - TIME[6]) * 2 * AXIS)
            means = np.concatenate([ARM, turn.apply(FORE - HINGE) + HINGE])
        state = Gaussians.of_points(means, radius=0.05)
        history.append(frame, frame / 30, state.replace(ids=ids[: len(means)]))
    (joint,) = joints(history, labels, WorldFrame(np.zeros(3)), range(FRAMES))
    assert np.isnan(joint.values[:6]).all()
    np.testing.assert_allclose(joint.values[6:], 2 * (TIME[6:] - TIME[6]), atol=1e-3)
