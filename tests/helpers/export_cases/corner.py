"""One asymmetric scene that goes through every format, and the comparison of what comes back.

Three arms of different lengths meet in a corner: x right (four steps), y down (three), z forward (two). No rotation or
mirror image of it looks alike, each Gaussian has its own colour, opacity and axes, and the axes are sheared. As the
user's camera at the origin sees it, all lies to the right, above the centre, and ahead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera, Rig, WorldFrame
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.appearance.direction import ROWS
from scas4d_core.query.harmonics import basis_of, harmonics

WORLD = WorldFrame(np.array([3.0, -7.0, 5.0]), metres_per_unit=0.01)
"""The user works in centimetres."""
CORNER = np.array([0.2, -1.4, 2.0])
ARMS = ((0, 4, 0.3), (1, 3, 0.2), (2, 2, 0.15))
"""Axis, number and distance of the Gaussians beside the corner, metres."""
COUNT = 10
X_END, Y_END, Z_END = 4, 7, 9
"""Rows at the ends of the arms; row 0 is the corner."""
Y_UP = np.array([1.0, -1.0, -1.0])
"""By hand: y up and z towards the viewer, from y down and z forward."""
GLOSSY = 6
DIRECTIONS = np.array([[1.0, 2, 2], [-2, 1, 2], [2, -2, 1], [-1, -2, -2]]) / 3
"""From a camera, in the user's world."""


def state(gloss: bool = False) -> Gaussians:
    """The scene in the inside world, ids from 50."""
    points = [CORNER] + [CORNER + np.eye(3)[axis] * step * (k + 1) for axis, n, step in ARMS for k in range(n)]
    rng = np.random.default_rng(5)
    lengths = np.sort(rng.uniform(0.01, 0.08, (COUNT, 3)), axis=1) * [1, 1.5, 2.2]
    sheared = np.eye(3) + 0.3 * rng.normal(size=(COUNT, 3, 3))
    factors = sheared @ (Rotation.random(COUNT, random_state=7).as_matrix() * lengths[:, None])
    made = Gaussians.of_points(points, 0.1).replace(
        factors=factors.astype(np.float32),
        opacities=np.linspace(0.15, 0.95, COUNT, dtype=np.float32),
        colours=rng.uniform(0.05, 0.9, (COUNT, 3)).astype(np.float32),
        ids=np.arange(COUNT, dtype=np.int64) + 50,
    )
    if not gloss:
        return made
    normals = rng.normal(size=(GLOSSY, 3))
    normals *= rng.uniform(0.3, 0.8, (GLOSSY, 1)) / np.linalg.norm(normals, axis=1, keepdims=True)
    around = rng.uniform(0, 0.6, (ROWS, 3)).astype(np.float32)
    around[-2:] = 0  # nothing is near
    return made.replace(gloss=normals.astype(np.float32), environment=around)


def rig() -> Rig:
    """Two cameras in the user's world, turned, off-centre, with pixels that are no squares."""
    lens = np.array([[400.0, 0, 300], [0, 420, 260], [0, 0, 1]])
    poses = []
    for turn, shift in (([5, -10, 3], [4.0, 9, 2]), ([-8, 12, -20], [-30.0, 15, 40])):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        pose[:3, 3] = shift
        poses.append(pose)
    return Rig((Camera("a-1", lens, poses[0], 640, 480), Camera("a.1", lens, poses[1], 640, 480)))


@dataclass
class Found:
    """Gaussians as a reader finds them, or as they should be."""

    means: np.ndarray
    covariances: np.ndarray
    colours: np.ndarray
    opacities: np.ndarray

    def rows(self, chosen: np.ndarray) -> Found:
        return Found(*(array[chosen] for array in vars(self).values()))


def wanted(of: Gaussians, axes: np.ndarray | None = None, metres: bool = False) -> Found:
    """The truth in the user's world and unit; or with each axis times ``axes``, or in metres.

    Colours are those of degree 0: where there is gloss, the mean over all directions.
    """
    unit = 1.0 if metres else 1 / WORLD.metres_per_unit
    factors = of.factors.astype(np.float64) * unit
    signs = np.ones(3) if axes is None else axes
    means = (of.means.astype(np.float64) / WORLD.metres_per_unit + WORLD.origin) * (
        WORLD.metres_per_unit if metres else 1
    )
    colours = of.colours if of.gloss is None else 0.5 + 0.28209479177387814 * harmonics(of)[:, 0]
    covariances = factors @ factors.transpose(0, 2, 1) * np.outer(signs, signs)
    return Found(means * signs, covariances, np.float64(colours), np.float64(of.opacities))


def errors(found: Found, truth: Found) -> dict[str, float]:
    """Largest errors: means in their unit, covariances relative to the largest entry of each, colours, opacities."""
    size = np.abs(truth.covariances).max(axis=(1, 2), keepdims=True)
    return {
        "means": float(np.abs(found.means - truth.means).max()),
        "covariances": float((np.abs(found.covariances - truth.covariances) / size).max()),
        "colours": float(np.abs(found.colours - truth.colours).max()),
        "opacities": float(np.abs(found.opacities - truth.opacities).max()),
    }


def assert_same(found: Found, truth: Found, **limits: float) -> None:
    """Compares within limits, and makes sure that a mirror image of the same would not pass."""
    measured = errors(found, truth)
    assert {name: value for name, value in measured.items() if not value <= limits[name]} == {}, measured
    for axis in range(3):
        mirror = np.where(np.arange(3) == axis, -1.0, 1.0)
        middle = truth.means.mean(axis=0)
        other = Found(
            (truth.means - middle) * mirror + middle,
            truth.covariances * np.outer(mirror, mirror),
            truth.colours,
            truth.opacities,
        )
        wrong = errors(found, other)
        assert wrong["means"] > 10 * limits["means"], f"axis {axis}: the scene cannot tell a mirror image by means"
        assert wrong["covariances"] > 3 * limits["covariances"], f"axis {axis}: nor by covariances"
    motion = np.linalg.lstsq(truth.means - truth.means[0], found.means - found.means[0], rcond=None)[0]
    assert np.linalg.det(motion) > 0.9  # no mirror image of the truth


def assert_y_up(means: np.ndarray) -> None:
    """What the user's camera sees to the right, above its centre and ahead is there in axes with y up, too."""
    assert (means > [0, 0, -np.inf]).all()
    assert (means[:, 2] < 0).all()
    assert means[X_END, 0] > means[0, 0]
    assert means[Y_END, 1] < means[0, 1]
    assert means[Z_END, 2] < means[0, 2]


def seen(coefficients: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """[N, 4, 3] colours from ``DIRECTIONS``, of harmonics [N, 16, 3] in a file with these axes."""
    return 0.5 + np.einsum("dk,nkc->ndc", basis_of(DIRECTIONS * axes), coefficients)


def seen_truly(of: Gaussians) -> np.ndarray:
    """[N, 4, 3] the same, of a state in the user's axes."""
    return seen(harmonics(of), np.ones(3))


def covariances(quaternions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """[N, 3, 3] of quaternions (x, y, z, w) and standard deviations."""
    axes = Rotation.from_quat(quaternions).as_matrix() * scales[:, None, :]
    return axes @ axes.transpose(0, 2, 1)
