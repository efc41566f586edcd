"""Cameras, rigs, and the similarity to the inside world. Numpy only.

Axes are OpenCV's: x right, y down, z forward; ``X_cam = R X_world + t``; ``u = fx x/z + cx``.
Pixel (column i, row j) covers [i, i+1) x [j, j+1); its centre is (i + 0.5, j + 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scas4d_core.errors import InputError

Float = NDArray[np.float64]

CAMERA_NAME = r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}$"
"""The names that captures and the service take: files are named after them, and none leads out of a folder."""
ROTATION_TOLERANCE = 1e-3
"""Largest entry of R Rᵀ − I that still counts as a rotation: calibration files round to 4–6 digits."""


class CameraError(InputError):
    """An impossible camera; the message names the camera, the field, the value and the remedy."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        name: identifies the camera within its rig.
        intrinsics: [3, 3] float64 in pixels, ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``.
        world_to_camera: [4, 4] float64, OpenCV axes.
        width, height: picture size in pixels.

    Raises:
        CameraError: not finite, focal length not positive, skew, no rotation, or empty picture.

    >>> lens = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    >>> camera = Camera("front", lens, np.eye(4), width=64, height=48)
    >>> uv, depth = camera.project([0.1, 0, 2])
    >>> uv, depth
    (array([37., 24.]), array(2.))
    >>> camera.unproject(uv, depth)
    array([0.1, 0. , 2. ])
    >>> camera.scaled(0.5).cx
    16.0
    """

    name: str
    intrinsics: Float
    world_to_camera: Float
    width: int
    height: int

    def __post_init__(self) -> None:
        for field, shape in (("intrinsics", (3, 3)), ("world_to_camera", (4, 4))):
            value = np.array(getattr(self, field), dtype=np.float64)
            if value.shape != shape:
                raise CameraError(f"camera {self.name!r}: {field} has shape {value.shape}", f"give {shape}")
            if not np.isfinite(value).all():
                raise CameraError(f"camera {self.name!r}: {field} holds NaN or infinity", "give finite numbers")
            value.setflags(write=False)
            object.__setattr__(self, field, value)
        with np.errstate(over="ignore", invalid="ignore"):  # numbers near the largest are no rotation either
            self._check()

    def _check(self) -> None:
        k, r = self.intrinsics, self.rotation
        if k[0, 0] <= 0 or k[1, 1] <= 0:
            raise CameraError(
                f"camera {self.name!r}: focal lengths {k[0, 0]:g}, {k[1, 1]:g} must be positive",
                "give positive focal lengths in pixels",
            )
        if abs(k[0, 1]) + abs(k[1, 0]) + abs(k[2, 0]) + abs(k[2, 1]) + abs(k[2, 2] - 1) > 1e-6:
            raise CameraError(
                f"camera {self.name!r}: intrinsics must be [[fx,0,cx],[0,fy,cy],[0,0,1]]", "undo skew first"
            )
        turns = np.abs(r @ r.T - np.eye(3)).max() <= ROTATION_TOLERANCE
        if turns and np.linalg.det(r) < 0:
            raise CameraError(
                f"camera {self.name!r}: the rotation world_to_camera[:3,:3] has determinant -1: a left-handed frame",
                "mirror one axis: if the world is left-handed, negate one of its axes for all cameras (that column of "
                "every rotation) and in the points; if the camera's axes are, negate the wrong row of the rotation and "
                "of the translation",
            )
        if not turns:
            raise CameraError(
                f"camera {self.name!r}: world_to_camera[:3,:3] is no rotation (determinant {np.linalg.det(r):.4g})",
                "give the rotation of world-to-camera with OpenCV axes",
            )
        if not np.allclose(self.world_to_camera[3], (0, 0, 0, 1)):
            raise CameraError(
                f"camera {self.name!r}: the last row of world_to_camera is not 0 0 0 1", "give a 4x4 pose"
            )
        if self.width < 1 or self.height < 1:
            raise CameraError(
                f"camera {self.name!r}: size {self.width}x{self.height} is empty", "give at least 1x1 pixels"
            )

    @property
    def fx(self) -> float:
        """Focal length in pixels along x."""
        return float(self.intrinsics[0, 0])

    @property
    def fy(self) -> float:
        """Focal length in pixels along y."""
        return float(self.intrinsics[1, 1])

    @property
    def cx(self) -> float:
        """Principal point, pixels from the left edge of the picture."""
        return float(self.intrinsics[0, 2])

    @property
    def cy(self) -> float:
        """Principal point, pixels from the upper edge of the picture."""
        return float(self.intrinsics[1, 2])

    @property
    def rotation(self) -> Float:
        """[3, 3] world to camera."""
        return self.world_to_camera[:3, :3]

    @property
    def translation(self) -> Float:
        """[3] world to camera."""
        return self.world_to_camera[:3, 3]

    @property
    def centre(self) -> Float:
        """[3] centre of projection in the world."""
        centre: Float = -self.rotation.T @ self.translation
        return centre

    def scaled(self, image_scale: float) -> Camera:
        """The camera for pictures resized by ``image_scale``; sizes round to whole pixels.

        With pixel centres at +0.5 a resize multiplies u, v (and so fx, fy, cx, cy) by the exact ratio of the sizes.
        """
        width = max(1, round(self.width * image_scale))
        height = max(1, round(self.height * image_scale))
        ratio = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.name, self.intrinsics * ratio, self.world_to_camera, width, height)

    def to_camera(self, points: ArrayLike) -> Float:
        """[..., 3] world points in camera axes."""
        result: Float = np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation
        return result

    def project(self, points: ArrayLike) -> tuple[Float, Float]:
        """[..., 3] world points to pixels [..., 2] and depths [...]; behind the camera (depth <= 0) pixels are NaN."""
        seen = self.to_camera(points)
        depth = seen[..., 2]
        safe = np.where(depth > 0, depth, np.nan)
        uv = np.stack([self.fx * seen[..., 0] / safe + self.cx, self.fy * seen[..., 1] / safe + self.cy], axis=-1)
        return uv, depth

    def unproject(self, uv: ArrayLike, depth: ArrayLike) -> Float:
        """Pixels [..., 2] at depths [...] (along z, not along the ray) to world points [..., 3]."""
        uv = np.asarray(uv, dtype=np.float64)
        z = np.asarray(depth, dtype=np.float64)
        x = (uv[..., 0] - self.cx) / self.fx * z
        y = (uv[..., 1] - self.cy) / self.fy * z
        result: Float = (np.stack([x, y, z], axis=-1) - self.translation) @ self.rotation
        return result


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """The similarity from the user's world to the inside world: ``inside = (user − origin) · metres_per_unit``.

    Attributes:
        origin: [3] float64, in the user's units.
        metres_per_unit: metres in one of the user's units.

    >>> world = WorldFrame(origin=np.array([10.0, 0, 0]), metres_per_unit=0.01)  # of centimetres
    >>> world.to_inside([110.0, 0, 0])
    array([1., 0., 0.])
    >>> world.to_user([1.0, 0, 0])
    array([110.,   0.,   0.])
    """

    origin: Float
    metres_per_unit: float = 1.0

    def to_inside(self, points: ArrayLike) -> Float:
        """[..., 3] user's units to metres about the origin."""
        result: Float = (np.asarray(points, dtype=np.float64) - self.origin) * self.metres_per_unit
        return result

    def to_user(self, points: ArrayLike) -> Float:
        """[..., 3] metres about the origin to the user's units."""
        result: Float = np.asarray(points, dtype=np.float64) / self.metres_per_unit + self.origin
        return result

    def camera_to_inside(self, camera: Camera) -> Camera:
        """The camera in the inside world; rotation and intrinsics stay."""
        pose = camera.world_to_camera.copy()
        pose[:3, 3] = (camera.rotation @ self.origin + camera.translation) * self.metres_per_unit
        return Camera(camera.name, camera.intrinsics, pose, camera.width, camera.height)


AUTO_RIG_RADIUS_M = 3.0
"""``metres_per_unit="auto"`` takes the rig's radius for this many metres: a room-sized stage."""
ONE_PLACE = 1e-8
"""User's units, or metres: a rig with a smaller radius is at one place; what is left is rounding of the poses."""

LONG_LENS = 2.0
"""Focal length over the longer side of the picture, from which a lens is long: one of 72 mm before film of 36 mm."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras that look at one scene; names are unique.

    >>> lens, pose = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4)
    >>> beside = pose.copy()
    >>> beside[0, 3] = -2  # the camera's centre is at x = 2
    >>> rig = Rig((Camera("left", lens, pose, 64, 48), Camera("right", lens, beside, 64, 48)))
    >>> rig.names, rig["right"].centre, rig.radius
    (('left', 'right'), array([2., 0., 0.]), 1.1)
    >>> rig.world_frame("auto").metres_per_unit  # the rig's radius is taken for 3 m
    2.727272727272727
    """

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if not names:
            raise CameraError("a rig needs at least one camera", "add one")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise CameraError(
                f"camera names must be unique within a rig, given twice: {', '.join(twice)}", "rename all but one"
            )

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, name: str) -> Camera:
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise KeyError(name)

    @property
    def names(self) -> tuple[str, ...]:
        """Camera names in the rig's order."""
        return tuple(camera.name for camera in self.cameras)

    @cached_property
    def centre(self) -> Float:
        """[3] mean of the camera centres; not to be written to."""
        centre: Float = np.mean([camera.centre for camera in self.cameras], axis=0)
        centre.setflags(write=False)
        return centre

    @property
    def radius(self) -> float:
        """1.1 x the largest distance of a camera centre from their mean: the scene radius of Dynamic3DGaussians.

        One camera, or several at one place, do not determine the size of a scene, and with radius 0 nothing would move:
        the radius is ``AUTO_RIG_RADIUS_M`` then, in the unit of the cameras.
        """
        return AUTO_RIG_RADIUS_M if self.at_one_place else self._spread

    @property
    def reach(self) -> float:
        """The radius, less where most lenses are longer than ``LONG_LENS``: what they show is a part of the scene.

        Rates of positions go by it: a step that is a pixel before a usual lens is ten before one ten times as long.
        """
        lens = float(np.median([camera.intrinsics[0, 0] / max(camera.width, camera.height) for camera in self.cameras]))
        return self.radius * min(1.0, LONG_LENS / lens)

    @property
    def at_one_place(self) -> bool:
        """True where the cameras have no extent by which the scene could be measured."""
        return self._spread < ONE_PLACE

    @cached_property
    def _spread(self) -> float:
        return float(1.1 * max(np.linalg.norm(camera.centre - self.centre) for camera in self.cameras))

    def world_frame(self, metres_per_unit: float | str = 1.0) -> WorldFrame:
        """The similarity to the inside world, which is recentred on the rig.

        Args:
            metres_per_unit: metres in one unit of the calibration, or "auto" to take the rig's radius for 3 m.

        Raises:
            CameraError: not a positive number, "auto" for cameras at one place, or poses too far away for numbers.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            far = not np.isfinite(self._spread)
        if far:
            raise CameraError("camera centres are too far away for numbers", "give world_to_camera in other units")
        if metres_per_unit == "auto":
            if self.at_one_place:
                raise CameraError(
                    f"metres_per_unit 'auto' goes by how far apart the cameras are, and {len(self)} camera(s) are at "
                    f"one place",
                    f"give metres_per_unit as a number, such that what they see is about {AUTO_RIG_RADIUS_M:g} m away",
                )
            metres = AUTO_RIG_RADIUS_M / self.radius
        else:
            metres = float(metres_per_unit)
            if not (np.isfinite(metres) and metres > 0):
                raise CameraError(f"metres_per_unit {metres_per_unit!r} must be a positive number or 'auto'")
        return WorldFrame(self.centre, metres)

    def scaled(self, image_scale: float) -> Rig:
        """The rig for pictures resized by ``image_scale``."""
        return Rig(tuple(camera.scaled(image_scale) for camera in self.cameras))


def rig_inside(frame: WorldFrame, cameras: Sequence[Camera]) -> Rig:
    """The rig of cameras moved to the inside world.

    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> rig_inside(WorldFrame(np.array([0.0, 0, 2]), 0.1), [camera])["front"].centre
    array([ 0. ,  0. , -0.2])
    """
    return Rig(tuple(frame.camera_to_inside(camera) for camera in cameras))


def farthest_first(centres: NDArray[np.floating], count: int) -> list[int]:
    """So many of the points [N, 3], from the first on: each next one is the farthest from those taken.

    >>> farthest_first(np.array([[0, 0, 0], [1, 0, 0], [5, 0, 0]]), 2)
    [0, 2]
    """
    nearest = np.full(len(centres), np.inf)
    taken: list[int] = []
    while len(taken) < min(count, len(centres)):
        taken.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(centres - centres[taken[-1]], axis=-1))
        nearest[taken[-1]] = -1
    return taken
