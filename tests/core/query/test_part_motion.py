"""The rigid motion of parts against known motions and against scipy."""

import numpy as np
import pytest
from export_cases import corner, moving
from scipy.spatial.transform import Rotation

from scas4d_core.errors import InputError
from scas4d_core.query.part_motion import PartMotion, majority_motion, part_labels, rigid_motion


def test_a_known_motion_is_found():
    rng = np.random.default_rng(0)
    before, weights = rng.normal(size=(30, 3)) + np.array([5, -2, 9]), rng.random(30)
    turn = Rotation.from_rotvec([1.0, -2.0, 0.4]).as_matrix()
    found, shift, left = rigid_motion(before, before @ turn.T + [1, 2, 3], weights)
    np.testing.assert_allclose(found, turn, atol=1e-8)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-7)
    assert left < 1e-7


def test_it_is_the_best_of_a_noisy_motion_as_scipy_finds_it():
    rng = np.random.default_rng(1)
    before, weights = rng.normal(size=(40, 3)), rng.random(40)
    after = before @ Rotation.from_rotvec([0.3, 0.9, -0.2]).as_matrix().T + 0.2 * rng.normal(size=(40, 3)) + 7
    found, _, left = rigid_motion(before, after, weights)
    share = weights / weights.sum()
    best, rssd = Rotation.align_vectors(after - share @ after, before - share @ before, weights=weights)
    np.testing.assert_allclose(found, best.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(left, rssd / np.sqrt(weights.sum()), rtol=1e-7)


def test_weights_count():
    before = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    after = before + np.array([0, 0, 2])
    after[3] += [0, 5, 0]  # one that goes its own way
    _, shift, left = rigid_motion(before, after, np.array([1, 1, 1, 1e-12]))
    np.testing.assert_allclose(shift, [0, 0, 2], atol=1e-9)
    assert left < 1e-5
    assert rigid_motion(before, after)[2] > 1


def test_points_of_another_part_do_not_turn_a_part_along():
    rng = np.random.default_rng(3)
    before, weights = rng.normal(size=(200, 3)), rng.uniform(0.5, 1, 200)
    turn = Rotation.from_rotvec([0, 0, 0.6])
    after = turn.apply(before) + [0.5, 0, 0] + 0.01 * rng.normal(size=(200, 3))
    after[:60] = before[:60]  # they stand
    found, shift, left = majority_motion(before, after, weights)
    assert np.degrees((Rotation.from_matrix(found) * turn.inv()).magnitude()) < 1
    np.testing.assert_allclose(shift, [0.5, 0, 0], atol=0.02)
    all_of_it, _, least = rigid_motion(before, after, weights)
    assert np.degrees((Rotation.from_matrix(all_of_it) * turn.inv()).magnitude()) > 5
    assert left >= least > 0.1  # what is left is told of all points


def test_the_majority_of_what_moves_as_one_is_all_of_it():
    rng = np.random.default_rng(4)
    before = rng.normal(size=(20, 3)) + np.array([1e3, 0, 0])
    turn = Rotation.from_rotvec([0.2, -0.4, 0.1])
    found, shift, left = majority_motion(before, turn.apply(before) + np.array([1, 2, 3]))
    np.testing.assert_allclose(found, turn.as_matrix(), atol=1e-7)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-4)
    assert left < 1e-5
    assert majority_motion(before[:1], before[:1] + 1.0)[2] == 0
    assert majority_motion(before, before + 1.0, np.zeros(20))[2] < 1e-9


def test_a_mirror_image_is_no_motion():
    before = np.random.default_rng(2).normal(size=(20, 3))
    turn, _, left = rigid_motion(before, before * [-1, 1, 1])
    np.testing.assert_allclose(np.linalg.det(turn), 1, atol=1e-9)
    assert left > 0.1


def test_what_points_leave_open_follows_the_turn_before():
    before = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    about_x = Rotation.from_rotvec([0.7, 0, 0]).as_matrix()
    np.testing.assert_allclose(rigid_motion(before, before, near=about_x)[0], about_x, atol=1e-6)
    np.testing.assert_allclose(rigid_motion(before, before)[0], np.eye(3), atol=1e-6)
    turn, shift, left = rigid_motion(before[:1], before[:1] + np.array([1, 2, 3]), near=about_x)
    np.testing.assert_allclose(turn, about_x, atol=1e-9)
    np.testing.assert_allclose(shift, [1, 2, 3], atol=1e-9)
    assert left == 0


def test_parts_of_a_scene_in_the_users_world():
    motion = PartMotion(moving.LABELS, moving.state(0), corner.WORLD)
    assert motion.parts == [0, 1]
    for frame in (0, 1, 3):
        for pose in motion.poses(moving.state(frame)):
            turn, shift = moving.motion(pose.part, frame)
            np.testing.assert_allclose(pose.rotation, turn, atol=2e-6)
            inside = corner.WORLD.to_inside(motion.origins[pose.part])
            np.testing.assert_allclose(pose.position, corner.WORLD.to_user(turn @ inside + shift), atol=1e-4)
            assert pose.residual < 1e-4


def test_those_that_are_not_there_do_not_count():
    first = moving.state(0).retire([1])
    motion = PartMotion(moving.LABELS, first, corner.WORLD)
    wrong = moving.state(1)
    means = wrong.means.copy()
    means[[1, 2]] += 100
    wrong = wrong.replace(means=means)
    assert motion.poses(wrong.retire([2]))[0].residual < 1e-4
    assert motion.poses(wrong)[0].residual > 100
    gone = wrong.retire(np.flatnonzero(moving.LABELS == 1))
    assert [pose.part for pose in motion.poses(gone)] == [0]


def test_labels():
    assert part_labels(np.array([1, 0, 2]), 2).tolist() == [1, 0]
    with pytest.raises(InputError, match="parts: no Gaussian of the first frame belongs to a part"):
        PartMotion(np.full(10, -1), moving.state(0), corner.WORLD)
    with pytest.raises(InputError, match=r"parts: labels have shape \(2,\) and type float64"):
        part_labels(np.array([0.0, 1.0]), 2)
