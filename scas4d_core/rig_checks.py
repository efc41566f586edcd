"""Checks of a rig before a scene starts: errors for unusable rigs, warnings for likely mistakes.

Importers, the service and the command ``reconstruct`` use the same functions, so that their
messages are identical.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import ONE_PLACE, Camera, CameraError, Rig
from scas4d_core.errors import exact
from scas4d_core.settings import SceneSettings

Float = NDArray[np.float64]

SMALLEST_SIDE = 11
"""Minimum image side in pixels after scaling: SSIM uses windows of 11 pixels, and a smaller image has no full window.
"""
FOCAL_LENGTHS = (0.05, 1000.0)
"""Range of focal lengths as multiples of the longer image side, for fields of view from 169° to 0.06°. Only
near-orthographic lenses are excluded; a rig that films flies reaches 17."""
RADII = (1e-6, 1e9)
"""Range of rig radii in metres; outside it, the unit is wrong, and float32 is too coarse for the scene."""

FEW_SEE, MAX_SEE = 0.25, 0.9
"""Fractions of cameras that see the common point of all viewing axes. Poses are suspect if few cameras see it with the
given poses, but nearly all would see it with inverted poses."""
POINTS_SEEN = 0.2
"""Minimum fraction of camera–point pairs in view with inverted poses for a warning. With the given poses, the fraction
must be at most ``FEW_SEE`` times as large. Point clouds of rooms extend beyond the images: a third of `basketball` is
in view."""
LEAST_CAMERAS = 3
"""Minimum number of cameras for a check without points, because any two axes come close to each other somewhere."""
NOT_PARALLEL = 1e-3
"""Minimum mean squared sine of the angles between the axes and any direction; below it, the axes count as parallel."""
LEAST_DEPTH = 0.05
"""Minimum depth of the common point as a fraction of the rig's extent; a nearer point is between the cameras."""
MAX_POINTS = 2000
"""Approximate number of points that are checked, sampled evenly from the cloud."""
SEEN_AT_ALL = 0.1
"""Minimum fraction of a cloud that must be in view of at least one camera."""
FAR = 100.0
"""Median distance of the points from the rig centre, in rig radii, above which their unit or world is probably wrong.
Not used if all cameras look in the same direction, because the distance is then unbounded."""
ONE_WAY = 0.9
"""Length of the mean viewing direction above which the cameras count as looking in the same direction."""

USUAL_RADIUS = 60.0
"""Rig radius in metres above which the unit is probably wrong. Small rigs are plausible for small objects."""


class RigError(CameraError):
    """Raised if a rig, its points or its settings are unusable.

    Attributes:
        field: dotted name of the field, as in a request to the service.
        value: rejected value.
    """

    def __init__(self, fault: str, remedy: str, field: str, value: object) -> None:
        super().__init__(fault, remedy)
        self.field, self.value = field, value


def check_rig(rig: Rig, scene: SceneSettings, positions: Float | None) -> None:
    """Raises an error if a rig, settings or initial points are unusable. No images are needed.

    Args:
        rig: rig in the user's world, at the size of the images.
        scene: scene settings; only the unit and the image scale are used.
        positions: [P, 3] point cloud in the user's world, or None.

    Raises:
        RigError: see ``check_scene``, ``check_start`` and ``check_points``.
    """
    check_scene(rig, scene)
    check_start(rig, positions is not None)
    if positions is not None:
        check_points(rig, positions)


def check_scene(rig: Rig, scene: SceneSettings) -> None:
    """Raises an error if a rig and settings are unusable, whatever the images and points are.

    Args:
        rig: rig in the user's world, at the size of the images.
        scene: scene settings; only the unit and the image scale are used.

    Raises:
        RigError: if the focal lengths, the image size or the extent of the rig are out of range.

    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> check_scene(Rig((camera,)), SceneSettings(image_scale=0.25))
    >>> check_scene(Rig((camera,)), SceneSettings(image_scale=0.1))
    Traceback (most recent call last):
    scas4d_core.rig_checks.RigError: image_scale 0.1 reduces camera 'front' from 64x48 to 6x5 pixels; use at least 0.23
    """
    for number, camera in enumerate(rig.cameras):
        longer = max(camera.width, camera.height)
        least, most = (exact(bound * longer) for bound in FOCAL_LENGTHS)
        for focal in (camera.fx, camera.fy):
            if not FOCAL_LENGTHS[0] <= focal / longer <= FOCAL_LENGTHS[1]:
                raise RigError(
                    f"camera {camera.name!r}: focal length {focal:g} px is {focal / longer:.3g} times the longer image "
                    f"side of {longer} px",
                    f"use focal lengths in pixels, {least} to {most}",
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
            f"use images of at least {SMALLEST_SIDE} pixels per side",
            f"rig.cameras.{number}",
            f"{camera.width}x{camera.height}",
        )
    raise RigError(
        f"image_scale {scale:g} reduces camera {camera.name!r} from {camera.width}x{camera.height} to "
        f"{small.width}x{small.height} pixels",
        f"use at least {exact(np.ceil(100 * least) / 100)}",
        "settings.scene.image_scale",
        scale,
    )


def _check_extent(rig: Rig, scene: SceneSettings) -> None:
    if scene.metres_per_unit == "auto" or rig.at_one_place:
        return
    radius = rig.radius * scene.metres_per_unit
    if not RADII[0] <= radius <= RADII[1]:
        raise RigError(
            f"metres_per_unit {scene.metres_per_unit:g} gives a rig radius of {radius:.3g} m",
            "use the number of metres per calibration unit, or 'auto'",
            "settings.scene.metres_per_unit",
            scene.metres_per_unit,
        )


def check_start(rig: Rig, has_points: bool) -> None:
    """Raises an error if a scene starts without points and all cameras are at the same position.

    Depth cannot be estimated from such images.

    Args:
        rig: rig in the user's world.
        has_points: whether initial points are given.

    Raises:
        RigError: if there are no points, and there is only one camera or all cameras are at the
            same position.

    >>> lens = [[100, 0, 32], [0, 100, 24], [0, 0, 1]]
    >>> check_start(Rig((Camera("front", lens, np.eye(4), 64, 48),)), has_points=False)
    Traceback (most recent call last):
    scas4d_core.rig_checks.RigError: there is only one camera and there are no points, so distances are unknown; ...
    """
    if has_points or not rig.at_one_place:
        return
    which = "there is only one camera" if len(rig) == 1 else f"all {len(rig)} cameras are at the same position"
    raise RigError(
        f"{which} and there are no points, so distances are unknown",
        "provide points of the first frame, or cameras at different positions",
        "points",
        "nothing",
    )


def check_points(rig: Rig, positions: Float) -> None:
    """Raises an error if all initial points are behind all cameras.

    Args:
        rig: rig in the user's world.
        positions: [P, 3] point cloud in the user's world.

    Raises:
        RigError: if no point is in front of any camera.
    """
    for cloud in (_some(positions), positions):  # a small sample usually suffices
        if any((camera.to_camera(cloud)[:, 2] > 0).any() for camera in rig.cameras):
            return
    raise RigError(
        "all points are behind all cameras",
        "use world_to_camera with OpenCV axes (z forward) and points in the same world; camera-to-world poses must be "
        "inverted",
        "points",
        f"{len(positions)} points",
    )


def rig_warnings(rig: Rig, scene: SceneSettings, positions: Float | None = None) -> list[str]:
    """Returns warnings about likely mistakes in the unit, the poses or the points of a usable rig.

    Args:
        rig: rig in the user's world.
        scene: scene settings; only the unit is used.
        positions: [P, 3] point cloud in the user's world, or None.
    """
    poses = pose_warnings(rig, positions)
    cloud = [] if poses or positions is None else cloud_warnings(rig, positions)
    return [*unit_warnings(rig, scene), *poses, *cloud]


def unit_warnings(rig: Rig, scene: SceneSettings) -> list[str]:
    """Returns a warning if the size of the rig suggests that ``metres_per_unit`` is wrong.

    Returns:
        A list with one warning, or an empty list.

    >>> lens, there = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4)
    >>> there[0, 3] = 4000
    >>> rig = Rig((Camera("0", lens, np.eye(4), 64, 48), Camera("1", lens, there, 64, 48)))
    >>> unit_warnings(rig, SceneSettings())
    ["the cameras are up to 2e+03 m from their centre with scene.metres_per_unit 1; use 0.001 for a calibration..."]
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
        f"the cameras are up to {radius:.3g} m from their centre with scene.metres_per_unit {unit:g}; use 0.001 for "
        "a calibration in millimetres, 0.01 for centimetres, or 'auto', because some limits are in metres"
    ]


def cloud_warnings(rig: Rig, positions: Float) -> list[str]:
    """Returns a warning if the cameras see hardly any points, or the points are very far away.

    Args:
        rig: rig in the user's world.
        positions: [P, 3] point cloud in the user's world.

    Returns:
        A list with one warning, or an empty list.

    >>> lens, beside = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4)
    >>> beside[0, 3] = -0.2
    >>> rig = Rig((Camera("0", lens, np.eye(4), 64, 48), Camera("1", lens, beside, 64, 48)))
    >>> cloud_warnings(rig, np.array([[0.1, 0, 3]]))
    []
    >>> cloud_warnings(rig, np.array([[8, 0, 3]]))
    ['the cameras see only 0% of the points; provide points in the world and unit of the calibration']
    """
    if len(rig) < 2 or rig.at_one_place or not len(positions):
        return []
    some = _some(positions)
    world = "provide points in the world and unit of the calibration"
    away = float(np.median(np.linalg.norm(some - rig.centre, axis=1))) / rig.radius
    if away > FAR and np.linalg.norm(np.mean([camera.rotation[2] for camera in rig.cameras], axis=0)) < ONE_WAY:
        return [f"the points are {away:.0f} rig radii away from the rig; {world}"]
    seen = float(np.mean(np.any(_seen(rig.cameras, some), axis=0)))
    if seen < SEEN_AT_ALL:
        return [f"the cameras see only {seen:.0%} of the points; {world}"]
    return []


def pose_warnings(rig: Rig, positions: Float | None = None) -> list[str]:
    """Returns a warning if the poses seem to be inverted (camera to world).

    With points, the evidence is that few points are in view, but many points would be in view with
    inverted poses. Without points, the evidence is the common point of the viewing axes. With the
    given poses, few cameras have this point in view or behind them. With inverted poses, nearly all
    cameras would have the common point in view.

    The axes of an outward-looking rig meet behind the cameras. The axes of a rig that looks in one
    direction never meet. With poses relative to one of the cameras, the axes often meet both with
    the given and with inverted poses. There is no warning then, because only the images could
    decide.

    Args:
        rig: rig in the user's world. Without points, a rig is checked only if it has at least
            three cameras.
        positions: [P, 3] point cloud in the user's world, or None.

    Returns:
        A list with one warning, or an empty list.

    >>> lens, ring = [[100, 0, 32], [0, 100, 24], [0, 0, 1]], []
    >>> for i, angle in enumerate((0, 2, 4)):
    ...     pose = np.eye(4)  # 3 away from the origin, and looking at it
    ...     pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    ...     pose[2, 3] = 3
    ...     ring.append(Camera(str(i), lens, pose, 64, 48))
    >>> pose_warnings(Rig(tuple(ring)))
    []
    >>> pose_warnings(Rig(tuple(_inverted(camera) for camera in ring)))[0]
    'the poses seem to be inverted (camera to world instead of world to camera): the viewing axes ...'
    """
    if positions is not None and len(positions):
        some = _some(positions)
        given = float(np.mean(_seen(rig.cameras, some)))
        if given > FEW_SEE:  # the fraction cannot be 1 / FEW_SEE times as large with inverted poses
            return []
        other = float(np.mean(_seen([_inverted(camera) for camera in rig.cameras], some)))
        if other < POINTS_SEEN or given > FEW_SEE * other:
            return []
        evidence = f"a camera sees {given:.0%} of the points on average, but {other:.0%} with inverted poses"
    else:
        if len(rig) < LEAST_CAMERAS:
            return []
        turned = [_inverted(camera) for camera in rig.cameras]
        given, other = _come_together(rig.cameras, behind=True), _come_together(turned, behind=False)
        if given > FEW_SEE or other < MAX_SEE:
            return []
        evidence = f"the viewing axes of {given:.0%} of the cameras meet, but {other:.0%} with inverted poses"
    return [
        f"the poses seem to be inverted (camera to world instead of world to camera): {evidence}; if so, invert them"
    ]


def _inverted(camera: Camera) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation.T, camera.centre
    return Camera(camera.name, camera.intrinsics, pose, camera.width, camera.height)


def _seen(cameras: Sequence[Camera], points: Float) -> NDArray[np.bool_]:
    """Returns whether each camera sees each point [P, 3], as [C, P] bool.

    The result equals that of `_sees` for each camera, but is computed for all cameras at once,
    because a service may check hundreds of rigs.
    """
    poses, lenses = np.stack([one.world_to_camera for one in cameras]), np.stack([one.intrinsics for one in cameras])
    sizes = np.array([(one.width, one.height) for one in cameras])[:, None]
    there = points @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
    depth = there[..., 2:]
    with np.errstate(invalid="ignore", divide="ignore"):
        uv = there[..., :2] / depth * lenses[:, None, [0, 1], [0, 1]] + lenses[:, None, :2, 2]
    return np.asarray(((depth > 0) & (uv >= 0) & (uv <= sizes)).all(axis=-1))


def _sees(camera: Camera, points: Float) -> NDArray[np.bool_]:
    """Returns whether each point [P, 3] is in front of the camera and within its image."""
    uv, _ = camera.project(points)  # NaN for points behind the camera
    with np.errstate(invalid="ignore"):
        inside = (uv >= 0) & (uv <= (camera.width, camera.height))
    return np.asarray(inside.all(axis=-1))


def _come_together(cameras: Sequence[Camera], *, behind: bool) -> float:
    """Returns the fraction of cameras that see the common point of all viewing axes.

    The common point is nearest to all axes, in the least-squares sense. The fraction is 0 if the
    axes are nearly parallel or all cameras are at the same position.

    Args:
        cameras: cameras to check.
        behind: whether a camera also counts if the point is behind the camera, and the camera sees
            the point after its reflection through the camera centre.
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
