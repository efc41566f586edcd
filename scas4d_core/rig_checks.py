"""Checks of a rig before a scene begins: what cannot work is refused, what looks wrong is said. Numpy only.

Importers, the service and ``reconstruct`` ask the same functions, so that each gives the same sentences.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import ONE_PLACE, Camera, CameraError, Rig
from scas4d_core.settings import SceneSettings

Float = NDArray[np.float64]

SMALLEST_SIDE = 11
"""Pixels, after scaling: SSIM compares windows of 11 pixels, and a smaller picture has none that is whole."""
FOCAL_LENGTHS = (0.05, 1000.0)
"""Of the longer side of the picture: fields of 169° and of 0.06°. All but orthographic lenses are taken: that of a
fly's rig has 17."""
RADII = (1e-6, 1e9)
"""Metres inside: beyond, a unit was mistaken, and float32 holds too little of a scene."""

FEW_SEE, MAX_SEE = 0.25, 0.9
"""Shares of the cameras in whose pictures their common point lies: poses are suspected where as given few see it, and
nearly all would the other way round."""
POINTS_SEEN = 0.2
"""Share of all pairs of a camera and a point that have to be in view the other way round, with at most ``FEW_SEE`` of
it as given. Clouds of rooms go beyond the pictures: of `basketball` a third is in view."""
LEAST_CAMERAS = 3
"""Without points: two axes come close to each other somewhere whatever they are."""
NOT_PARALLEL = 1e-3
"""Smallest mean squared sine between the axes and any direction: below, they are parallel and have no common point."""
LEAST_DEPTH = 0.05
"""Of the rig's extent: a common point that is nearer to a camera is where the cameras themselves are."""
MAX_POINTS = 2000
"""Points of a cloud that are looked at, evenly out of all."""
SEEN_AT_ALL = 0.1
"""Share of a cloud that the cameras together have to have in view."""
FAR = 100.0
"""Radii of the rig from its middle to the points, in the median, from which their unit or world is questioned. Not of
cameras that look all one way: nothing says how far."""
ONE_WAY = 0.9
"""Length of the mean of the viewing axes, from which the cameras look one way."""

USUAL_RADIUS = 60.0
"""Metres: a larger rig was probably measured in another unit. Small ones stand before small things."""


class RigError(CameraError):
    """A rig, or settings for it, with which a scene cannot work.

    Attributes:
        field: dotted, as in a request to the service. value: as it was given.
    """

    def __init__(self, fault: str, remedy: str, field: str, value: object) -> None:
        super().__init__(fault, remedy)
        self.field, self.value = field, value


def check_rig(rig: Rig, scene: SceneSettings, positions: Float | None) -> None:
    """Refuses a rig, settings and points of a first frame that cannot work, before any of its pictures is looked at.

    Args:
        rig: in the user's world, at the size of the pictures. scene: its unit and scale.
        positions: [P, 3] of the cloud in the same world, or None.

    Raises:
        RigError: see ``check_scene``, ``check_start`` and ``check_points``.
    """
    check_scene(rig, scene)
    check_start(rig, positions is not None)
    if positions is not None:
        check_points(rig, positions)


def check_scene(rig: Rig, scene: SceneSettings) -> None:
    """Refuses what cannot work, whatever the pictures show.

    Args:
        rig: in the user's world, at the size of the pictures. scene: its unit and scale.

    Raises:
        RigError: absurd focal lengths, pictures of a few pixels, or a rig of absurd extent.

    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> check_scene(Rig((camera,)), SceneSettings(image_scale=0.25))
    >>> check_scene(Rig((camera,)), SceneSettings(image_scale=0.1))
    Traceback (most recent call last):
    scas4d_core.rig_checks.RigError: image_scale 0.1 leaves 6x5 of 64x48 pixels for camera 'front'; give at least 0.23
    """
    for number, camera in enumerate(rig.cameras):
        longer = max(camera.width, camera.height)
        for focal in (camera.fx, camera.fy):
            if not FOCAL_LENGTHS[0] <= focal / longer <= FOCAL_LENGTHS[1]:
                raise RigError(
                    f"camera {camera.name!r}: focal length {focal:g} px is {focal / longer:.3g} times its longer side "
                    f"of {longer} px",
                    f"give focal lengths in pixels, {FOCAL_LENGTHS[0] * longer:g} to {FOCAL_LENGTHS[1] * longer:g}",
                    f"rig.cameras.{number}.intrinsics",
                    focal,
                )
        small = camera.scaled(scene.image_scale)
        if min(small.width, small.height) < SMALLEST_SIDE:
            _too_small(camera, small, number, scene.image_scale)
    _check_extent(rig, scene)


def _too_small(camera: Camera, small: Camera, number: int, scale: float) -> None:
    least = SMALLEST_SIDE / min(camera.width, camera.height)
    if least > 1:
        raise RigError(
            f"camera {camera.name!r} has {camera.width}x{camera.height} pixels",
            f"give pictures of at least {SMALLEST_SIDE} pixels a side",
            f"rig.cameras.{number}",
            f"{camera.width}x{camera.height}",
        )
    raise RigError(
        f"image_scale {scale:g} leaves {small.width}x{small.height} of {camera.width}x{camera.height} pixels for "
        f"camera {camera.name!r}",
        f"give at least {np.ceil(100 * least) / 100:g}",
        "settings.scene.image_scale",
        scale,
    )


def _check_extent(rig: Rig, scene: SceneSettings) -> None:
    if scene.metres_per_unit == "auto" or rig.at_one_place:
        return
    radius = rig.radius * scene.metres_per_unit
    if not RADII[0] <= radius <= RADII[1]:
        raise RigError(
            f"metres_per_unit {scene.metres_per_unit:g} makes the rig's radius {radius:.3g} m",
            "give the metres in one unit of the calibration, or 'auto'",
            "settings.scene.metres_per_unit",
            scene.metres_per_unit,
        )


def check_start(rig: Rig, has_points: bool) -> None:
    """Refuses to begin without points where no two cameras are apart: no depth can be found.

    Raises:
        RigError: one camera, or all at one place, and no points.

    >>> lens = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    >>> check_start(Rig((Camera("front", lens, np.eye(4), 64, 48),)), has_points=False)
    Traceback (most recent call last):
    scas4d_core.rig_checks.RigError: one camera, and no points: distances are unknown; give points ...
    """
    if has_points or not rig.at_one_place:
        return
    which = "one camera" if len(rig) == 1 else f"all {len(rig)} cameras are at one place"
    raise RigError(
        f"{which}, and no points: distances are unknown",
        "give points of the first frame, or cameras that stand apart",
        "points",
        "nothing",
    )


def check_points(rig: Rig, positions: Float) -> None:
    """Refuses points [P, 3] of the user's world that lie behind every camera, each of them.

    Raises:
        RigError: no camera can see any.
    """
    for cloud in (_some(positions), positions):  # one of few is before a camera mostly
        if any((camera.to_camera(cloud)[:, 2] > 0).any() for camera in rig.cameras):
            return
    raise RigError(
        "all points lie behind all cameras",
        "give world_to_camera with OpenCV axes (z forward), and points in the same world; poses from camera to world "
        "have to be inverted",
        "points",
        f"{len(positions)} points",
    )


def rig_warnings(rig: Rig, scene: SceneSettings, positions: Float | None = None) -> list[str]:
    """Sentences on what may be wrong with a rig that can work: its unit, its poses, its cloud.

    Args:
        rig: in the user's world. scene: its unit. positions: [P, 3] of the cloud in the same world, or None.
    """
    poses = pose_warnings(rig, positions)
    cloud = [] if poses or positions is None else cloud_warnings(rig, positions)
    return [*unit_warnings(rig, scene), *poses, *cloud]


def unit_warnings(rig: Rig, scene: SceneSettings) -> list[str]:
    """A sentence where the rig is as large as if its unit were not the metre; else none.

    >>> lens, there = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4)
    >>> there[0, 3] = 4000
    >>> rig = Rig((Camera("0", lens, np.eye(4), 64, 48), Camera("1", lens, there, 64, 48)))
    >>> unit_warnings(rig, SceneSettings())
    ["the cameras are up to 2e+03 m from their middle with scene.metres_per_unit 1: for a calibration in milli..."]
    >>> unit_warnings(rig, SceneSettings(metres_per_unit=0.001))
    []
    """
    unit = scene.metres_per_unit
    if unit == "auto" or rig.at_one_place:
        return []
    radius = rig.radius * unit / 1.1
    if radius <= USUAL_RADIUS:
        return []
    return [
        f"the cameras are up to {radius:.3g} m from their middle with scene.metres_per_unit {unit:g}: "
        "for a calibration in millimetres give 0.001, in centimetres 0.01, or 'auto'; some limits are in metres"
    ]


def cloud_warnings(rig: Rig, positions: Float) -> list[str]:
    """A sentence on points [P, 3] that no camera has in view, or that lie far off; none where they fit.

    >>> lens, beside = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4)
    >>> beside[0, 3] = -0.2
    >>> rig = Rig((Camera("0", lens, np.eye(4), 64, 48), Camera("1", lens, beside, 64, 48)))
    >>> cloud_warnings(rig, np.array([[0.1, 0, 3]]))
    []
    >>> cloud_warnings(rig, np.array([[8, 0, 3]]))
    ['the cameras have only 0% of the points in view: give them in the world and the unit of the calibration']
    """
    if len(rig) < 2 or rig.at_one_place or not len(positions):
        return []
    some = _some(positions)
    world = "give them in the world and the unit of the calibration"
    away = float(np.median(np.linalg.norm(some - rig.centre, axis=1))) / rig.radius
    if away > FAR and np.linalg.norm(np.mean([camera.rotation[2] for camera in rig.cameras], axis=0)) < ONE_WAY:
        return [f"the points are {away:.0f} radii of the rig away from it: {world}"]
    seen = float(np.mean(np.any(_seen(rig.cameras, some), axis=0)))
    if seen < SEEN_AT_ALL:
        return [f"the cameras have only {seen:.0%} of the points in view: {world}"]
    return []


def pose_warnings(rig: Rig, positions: Float | None = None) -> list[str]:
    """Sentences on poses that seem to be the wrong way round, camera to world; none where nothing speaks for it.

    With points: they are out of view, and would be in view the other way round. Without: the viewing axes come
    together nowhere, before or behind the cameras, and would in nearly all pictures. Rigs that look outward come
    together behind, those that look all one way neither way. Poses in the world of one of the cameras often come
    together both ways: nothing is reported then, as only pictures could decide.

    Args:
        rig: of at least three cameras where there are no points. positions: [P, 3] in its world, or None.

    >>> lens, ring = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], []
    >>> for i, angle in enumerate((0, 2, 4)):
    ...     pose = np.eye(4)  # 3 away from the origin, and looking at it
    ...     pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    ...     pose[2, 3] = 3
    ...     ring.append(Camera(str(i), lens, pose, 64, 48))
    >>> pose_warnings(Rig(tuple(ring)))
    []
    >>> pose_warnings(Rig(tuple(_inverted(camera) for camera in ring)))[0]
    'the poses seem to be the wrong way round, camera to world where world to camera is meant: the viewing axes ...'
    """
    if positions is not None and len(positions):
        some = _some(positions)
        given = float(np.mean(_seen(rig.cameras, some)))
        if given > FEW_SEE:  # no other way round can show so much more
            return []
        other = float(np.mean(_seen([_inverted(camera) for camera in rig.cameras], some)))
        if other < POINTS_SEEN or given > FEW_SEE * other:
            return []
        evidence = f"{given:.0%} of the points are in view of a camera on average, inverted {other:.0%}"
    else:
        if len(rig) < LEAST_CAMERAS:
            return []
        turned = [_inverted(camera) for camera in rig.cameras]
        given, other = _come_together(rig.cameras, behind=True), _come_together(turned, behind=False)
        if given > FEW_SEE or other < MAX_SEE:
            return []
        evidence = f"the viewing axes of {given:.0%} of the cameras come together, inverted those of {other:.0%}"
    return [
        f"the poses seem to be the wrong way round, camera to world where world to camera is meant: {evidence}; "
        "invert them if that is so"
    ]


def _inverted(camera: Camera) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation.T, camera.centre
    return Camera(camera.name, camera.intrinsics, pose, camera.width, camera.height)


def _seen(cameras: Sequence[Camera], points: Float) -> NDArray[np.bool_]:
    """[C, P] as `_sees`, of all cameras at once: a service may start over hundreds of rigs."""
    poses, lenses = np.stack([one.world_to_camera for one in cameras]), np.stack([one.intrinsics for one in cameras])
    sizes = np.array([(one.width, one.height) for one in cameras])[:, None]
    there = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    depth = there[..., 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        uv = there[..., :2] / depth * lenses[:, None, [0, 1], [0, 1]] + lenses[:, None, :2, 2]
    return np.asarray(((depth > 0) & (uv >= 0) & (uv <= sizes)).all(axis=-1))


def _sees(camera: Camera, points: Float) -> NDArray[np.bool_]:
    """True for each point [P, 3] that is before the camera and within its picture."""
    uv, _ = camera.project(points)  # NaN behind
    with np.errstate(invalid="ignore"):
        inside = (uv >= 0) & (uv <= (camera.width, camera.height))
    return np.asarray(inside.all(axis=-1))


def _come_together(cameras: Sequence[Camera], *, behind: bool) -> float:
    """The share of the cameras in whose picture the point nearest to all viewing axes lies; 0 where there is none.

    Args:
        behind: a point behind a camera counts as well, in the picture on the other side.
    """
    axes = np.array([camera.rotation[2] for camera in cameras])
    centres = np.array([camera.centre for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < NOT_PARALLEL:
        return 0.0
    middle = centres.mean(axis=0)
    point = middle + np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres - middle))
    extent = float(np.linalg.norm(centres - middle, axis=1).max())
    if extent < ONE_PLACE:
        return 0.0
    together = 0
    for camera in cameras:
        depth = float(camera.to_camera(point)[2])
        mirrored = 2 * camera.centre - point if behind and depth < 0 else point
        together += abs(depth) > LEAST_DEPTH * extent and bool(_sees(camera, mirrored))
    return together / len(cameras)


def _some(positions: Float) -> Float:
    return np.asarray(positions, np.float64)[:: max(1, len(positions) // MAX_POINTS)]
