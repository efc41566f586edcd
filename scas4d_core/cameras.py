"""Cameras, rigs of cameras, and the similarity transform to the internal world frame.

Camera axes follow OpenCV: x right, y down, z forward; ``X_cam = R X_world + t``;
``u = fx x/z + cx``. Pixel (column i, row j) covers [i, i+1) x [j, j+1), and its centre is
(i + 0.5, j + 0.5). This module requires only NumPy.
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
"""Pattern of valid camera names. Names are used as file names, so path separators are not allowed."""
ROTATION_TOLERANCE = 1e-3
"""Maximum absolute entry of R Rᵀ − I for a valid rotation R; calibration files are rounded to 4–6 digits."""


class CameraError(InputError):
    """Raised if a camera or a rig is invalid. The message names the problem and the remedy."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera without distortion.

    Attributes:
        name: unique name of the camera within its rig.
        intrinsics: [3, 3] float64 intrinsic matrix ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]``, in pixels.
        world_to_camera: [4, 4] float64 transform from world to camera coordinates, with OpenCV axes.
        width, height: image size in pixels.

    Raises:
        CameraError: if a matrix has the wrong shape or contains NaN or infinity. Also if a focal
            length is not positive, the intrinsics have skew, the pose is not rigid, or the image is
            empty.

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
                raise CameraError(f"camera {self.name!r}: {field} has shape {value.shape}", f"expected {shape}")
            if not np.isfinite(value).all():
                raise CameraError(f"camera {self.name!r}: {field} contains NaN or infinity", "use finite numbers")
            value.setflags(write=False)
            object.__setattr__(self, field, value)
        with np.errstate(over="ignore", invalid="ignore"):  # values that overflow fail the checks
            self._check()

    def _check(self) -> None:
        k, r = self.intrinsics, self.rotation
        if k[0, 0] <= 0 or k[1, 1] <= 0:
            raise CameraError(
                f"camera {self.name!r}: focal lengths must be positive, got {k[0, 0]:g} and {k[1, 1]:g}",
                "specify the focal lengths in pixels",
            )
        if abs(k[0, 1]) + abs(k[1, 0]) + abs(k[2, 0]) + abs(k[2, 1]) + abs(k[2, 2] - 1) > 1e-6:
            raise CameraError(
                f"camera {self.name!r}: intrinsics must be [[fx,0,cx],[0,fy,cy],[0,0,1]]", "remove any skew first"
            )
        turns = np.abs(r @ r.T - np.eye(3)).max() <= ROTATION_TOLERANCE
        if turns and np.linalg.det(r) < 0:
            raise CameraError(
                f"camera {self.name!r}: the rotation world_to_camera[:3,:3] has determinant -1 (left-handed)",
                "flip one axis: if the world is left-handed, negate one world axis for all cameras (the same column of "
                "each rotation) and in the points; if the camera axes are left-handed, negate the row of the flipped "
                "axis in the rotation and the translation",
            )
        if not turns:
            raise CameraError(
                f"camera {self.name!r}: world_to_camera[:3,:3] is not a rotation (determinant {np.linalg.det(r):.4g})",
                "use a world-to-camera rotation with OpenCV axes",
            )
        if not np.allclose(self.world_to_camera[3], (0, 0, 0, 1)):
            raise CameraError(
                f"camera {self.name!r}: the last row of world_to_camera must be 0 0 0 1", "use a rigid 4x4 pose"
            )
        if self.width < 1 or self.height < 1:
            raise CameraError(
                f"camera {self.name!r}: invalid image size {self.width}x{self.height}", "use at least 1x1 pixels"
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
        """Distance of the principal point from the left edge of the image, in pixels."""
        return float(self.intrinsics[0, 2])

    @property
    def cy(self) -> float:
        """Distance of the principal point from the top edge of the image, in pixels."""
        return float(self.intrinsics[1, 2])

    @property
    def rotation(self) -> Float:
        """[3, 3] world-to-camera rotation."""
        return self.world_to_camera[:3, :3]

    @property
    def translation(self) -> Float:
        """[3] world-to-camera translation."""
        return self.world_to_camera[:3, 3]

    @property
    def centre(self) -> Float:
        """[3] centre of projection in world coordinates."""
        centre: Float = -self.rotation.T @ self.translation
        return centre

    def scaled(self, image_scale: float) -> Camera:
        """Returns the camera for images resized by ``image_scale``.

        The new image size is rounded to whole pixels. Pixel centres are at +0.5, so resizing
        multiplies u and v by the ratio of the new to the old size. The same factors apply to fx,
        fy, cx and cy.
        """
        width = max(1, round(self.width * image_scale))
        height = max(1, round(self.height * image_scale))
        ratio = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.name, self.intrinsics * ratio, self.world_to_camera, width, height)

    def to_camera(self, points: ArrayLike) -> Float:
        """Transforms world points [..., 3] to camera coordinates."""
        result: Float = np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation
        return result

    def project(self, points: ArrayLike) -> tuple[Float, Float]:
        """Projects world points [..., 3] to pixel coordinates [..., 2] and depths [...].

        The pixel coordinates are NaN for points with a depth of 0 or less.
        """
        seen = self.to_camera(points)
        depth = seen[..., 2]
        safe = np.where(depth > 0, depth, np.nan)
        uv = np.stack([self.fx * seen[..., 0] / safe + self.cx, self.fy * seen[..., 1] / safe + self.cy], axis=-1)
        return uv, depth

    def in_image(self, uv: ArrayLike) -> NDArray[np.bool_]:
        """Returns whether pixel coordinates [..., 2] are in the image, [...] bool; NaN coordinates are not.

        Points with a depth of 0 or less are not in the image, because ``project`` returns NaN for them.

        >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
        >>> camera.in_image([[0, 0], [63.9, 47.9], [64, 0], [np.nan, 0]])
        array([ True,  True, False, False])
        """
        uv = np.asarray(uv, dtype=np.float64)
        return np.asarray(((uv >= 0) & (uv < (self.width, self.height))).all(axis=-1))

    def unproject(self, uv: ArrayLike, depth: ArrayLike) -> Float:
        """Converts pixel coordinates [..., 2] and depths [...] to world points [..., 3].

        Depths are measured along the z axis of the camera, not along the viewing ray.
        """
        uv = np.asarray(uv, dtype=np.float64)
        z = np.asarray(depth, dtype=np.float64)
        x = (uv[..., 0] - self.cx) / self.fx * z
        y = (uv[..., 1] - self.cy) / self.fy * z
        result: Float = (np.stack([x, y, z], axis=-1) - self.translation) @ self.rotation
        return result


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """Similarity transform from the user's world to the internal world of a scene.

    The transform is ``inside = (user − origin) · metres_per_unit``. It does not rotate.

    Attributes:
        origin: [3] float64 origin of the internal world, in the user's world and units.
        metres_per_unit: metres per user unit.

    >>> world = WorldFrame(origin=np.array([10.0, 0, 0]), metres_per_unit=0.01)  # the user's unit is 1 cm
    >>> world.to_inside([110.0, 0, 0])
    array([1., 0., 0.])
    >>> world.to_user([1.0, 0, 0])
    array([110.,   0.,   0.])
    """

    origin: Float
    metres_per_unit: float = 1.0

    def to_inside(self, points: ArrayLike) -> Float:
        """Converts points [..., 3] from the user's world to the internal world (metres)."""
        result: Float = (np.asarray(points, dtype=np.float64) - self.origin) * self.metres_per_unit
        return result

    def to_user(self, points: ArrayLike) -> Float:
        """Converts points [..., 3] from the internal world (metres) to the user's world."""
        result: Float = np.asarray(points, dtype=np.float64) / self.metres_per_unit + self.origin
        return result

    def camera_to_inside(self, camera: Camera) -> Camera:
        """Converts a camera from the user's world to the internal world.

        The rotation and the intrinsics of the camera do not change.
        """
        pose = camera.world_to_camera.copy()
        pose[:3, 3] = (camera.rotation @ self.origin + camera.translation) * self.metres_per_unit
        return Camera(camera.name, camera.intrinsics, pose, camera.width, camera.height)


AUTO_RIG_RADIUS_M = 3.0
"""Rig radius in metres that ``metres_per_unit="auto"`` assumes, typical of a room-sized stage."""
ONE_PLACE = 1e-8
"""Rig radius, in user units or metres, below which all cameras are considered to be at the same position."""

LONG_LENS = 2.0
"""Ratio of focal length to the longer image side above which a lens counts as long; equivalent to 72 mm on 36 mm film.
"""


def minimum_cameras(count: int, minimum: int | None = None) -> int:
    """Returns how many of `count` cameras must have a usable image in a frame: at most `minimum`, by default half.

    >>> minimum_cameras(5), minimum_cameras(5, 2), minimum_cameras(5, 9)
    (3, 2, 5)
    """
    return -(-count // 2) if minimum is None else min(minimum, count)


@dataclass(frozen=True, eq=False)
class Rig:
    """Ordered set of uniquely named cameras that observe the same scene.

    Raises:
        CameraError: if there is no camera, or two cameras have the same name.

    >>> lens, pose = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4)
    >>> beside = pose.copy()
    >>> beside[0, 3] = -2  # the camera's centre is at x = 2
    >>> rig = Rig((Camera("left", lens, pose, 64, 48), Camera("right", lens, beside, 64, 48)))
    >>> rig.names, rig["right"].centre, rig.radius
    (('left', 'right'), array([2., 0., 0.]), 1.1)
    >>> rig.world_frame("auto").metres_per_unit  # assumes a rig radius of 3 m
    2.727272727272727
    """

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        names = [camera.name for camera in self.cameras]
        if not names:
            raise CameraError("the rig has no cameras", "add at least one")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise CameraError(
                f"camera names must be unique within a rig; duplicates: {', '.join(twice)}", "rename all but one"
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
        """Camera names in rig order."""
        return tuple(camera.name for camera in self.cameras)

    @cached_property
    def centre(self) -> Float:
        """[3] mean of the camera centres; read-only."""
        centre: Float = np.mean([camera.centre for camera in self.cameras], axis=0)
        centre.setflags(write=False)
        return centre

    @property
    def radius(self) -> float:
        """1.1 times the largest distance of a camera from the mean camera centre, as in Dynamic3DGaussians.

        A single camera does not determine the size of the scene, and neither do several cameras at
        the same position. A radius of 0 would result in learning rates of 0. In these cases, the
        radius is ``AUTO_RIG_RADIUS_M``, in the unit of the cameras.
        """
        return AUTO_RIG_RADIUS_M if self.at_one_place else self._spread

    @property
    def reach(self) -> float:
        """Length to which the learning rates of positions are proportional: the rig radius or less.

        The value is smaller than the radius if the cameras have long lenses, which see only part of
        the scene. A lens counts as long if the ratio of focal length to longer image side exceeds
        ``LONG_LENS``; the median over the cameras decides. A step that moves a point by one pixel
        with a normal lens moves it by ten pixels with a lens ten times as long.
        """
        lens = float(np.median([camera.intrinsics[0, 0] / max(camera.width, camera.height) for camera in self.cameras]))
        return self.radius * min(1.0, LONG_LENS / lens)

    @property
    def at_one_place(self) -> bool:
        """Whether all camera centres coincide, and thus do not determine the scale of the scene."""
        return self._spread < ONE_PLACE

    @cached_property
    def _spread(self) -> float:
        return float(1.1 * max(np.linalg.norm(camera.centre - self.centre) for camera in self.cameras))

    def world_frame(self, metres_per_unit: float | str = 1.0) -> WorldFrame:
        """Returns the similarity transform to the internal world, which is centred on the rig.

        Args:
            metres_per_unit: metres per calibration unit, or "auto" to assume a rig radius of 3 m.

        Raises:
            CameraError: if the value is not positive, "auto" is used although all cameras are at
                the same position, or the camera centres overflow.
        """
        with np.errstate(over="ignore", invalid="ignore"):
            far = not np.isfinite(self._spread)
        if far:
            raise CameraError("camera centres are too far from the origin", "use larger units for world_to_camera")
        if metres_per_unit == "auto":
            if self.at_one_place:
                raise CameraError(
                    f"metres_per_unit 'auto' requires cameras at different positions, but all {len(self)} camera(s) "
                    "are at the same position",
                    f"set metres_per_unit to a number that puts the subject about {AUTO_RIG_RADIUS_M:g} m away",
                )
            metres = AUTO_RIG_RADIUS_M / self.radius
        else:
            metres = float(metres_per_unit)
            if not (np.isfinite(metres) and metres > 0):
                raise CameraError(f"metres_per_unit must be a positive number or 'auto'; got {metres_per_unit!r}")
        return WorldFrame(self.centre, metres)

    def scaled(self, image_scale: float) -> Rig:
        """Returns the rig for images resized by ``image_scale``."""
        return Rig(tuple(camera.scaled(image_scale) for camera in self.cameras))


def rig_inside(frame: WorldFrame, cameras: Sequence[Camera]) -> Rig:
    """Returns a rig with the cameras transformed to the internal world.

    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> rig_inside(WorldFrame(np.array([0.0, 0, 2]), 0.1), [camera])["front"].centre
    array([ 0. ,  0. , -0.2])
    """
    return Rig(tuple(frame.camera_to_inside(camera) for camera in cameras))


def farthest_first(centres: NDArray[np.floating], count: int) -> list[int]:
    """Selects points by farthest-point sampling, and returns their indices.

    Args:
        centres: [N, 3] points. The first point is always selected.
        count: number of points to select. If there are fewer points, all of them are selected.

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
