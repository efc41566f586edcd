"""The comparison of joints with true poses, on a hinge that is known."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from scas4d_core.captures.ground_truth import TruePart
from scas4d_core.query.joints import Joint
from studies.exports.joint_truth import compare_joint, report

FRAMES = list(range(6))
ANGLES = 0.3 * np.arange(6)
AXIS, HINGE = np.array([0, 0.6, 0.8]), np.array([1.0, 2, 3])


def pose(turns, off):
    """Returns poses [T, 4, 4] that turn about the hinge; the part's own coordinates lie elsewhere."""
    made = np.tile(np.eye(4), (len(turns), 1, 1))
    made[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    made[:, :3, 3] = HINGE - made[:, :3, :3] @ HINGE
    shift = np.eye(4)
    shift[:3, 3] = off
    return made @ shift


PARENT = TruePart(3, "arm", True, False, True, pose(np.zeros((6, 3)), [1, 1, 1]))
CHILD = TruePart(8, "hand", True, False, True, pose(ANGLES[:, None] * AXIS, [4, -2, 0]))
EXACT = Joint(0, 1, "revolute", np.tile(AXIS, (6, 1)), np.tile(HINGE, (6, 1)), ANGLES, 0.0)


def test_a_known_hinge_has_no_error():
    found = compare_joint(EXACT, PARENT, CHILD, True, FRAMES, 10.0)
    assert found.true
    assert found.between == ("arm", "hand")
    np.testing.assert_allclose([found.drift, found.axis, found.angle], 0, atol=1e-4)
    turned_over = replace(EXACT, axes=-EXACT.axes, values=-EXACT.values)
    np.testing.assert_allclose(compare_joint(turned_over, PARENT, CHILD, True, FRAMES, 10.0).angle, 0, atol=1e-4)


def test_errors_of_axis_angle_and_centre():
    across = np.array([1.0, 0, 0])
    tilted = Rotation.from_rotvec(np.radians(5) * across).apply(AXIS)
    wrong = replace(EXACT, axes=np.tile(tilted, (6, 1)), values=ANGLES + np.radians([0, 2, 0, 2, 0, 2]))
    found = compare_joint(wrong, PARENT, CHILD, True, FRAMES, 10.0)
    np.testing.assert_allclose([found.axis, found.angle], [5, np.sqrt(2)], rtol=1e-3)
    beside = compare_joint(replace(EXACT, centres=EXACT.centres + 3 * across), PARENT, CHILD, True, FRAMES, 10.0)
    chords = 3 * 2 * np.sin(ANGLES / 2)  # the point turns about the true axis
    np.testing.assert_allclose(beside.drift, 10 * np.sqrt(np.mean(chords**2)), rtol=1e-6)
    assert not beside.true
    unknown = compare_joint(EXACT, PARENT, CHILD, False, FRAMES, 10.0)
    assert not unknown.true
    text = report([found, beside, unknown], 4)
    assert text.startswith("1 of 4 true joints; 3 joints")
    assert text.count("| no |") == 2
