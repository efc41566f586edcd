"""What cannot work is refused by name; poses the wrong way round are suspected, and sound rigs are not."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.cameras import Camera, CameraError, Rig
from scas4d_core.captures import InitialPoints
from scas4d_core.captures.frame import Frame
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.rig_checks import (
    RigError,
    check_points,
    check_rig,
    check_scene,
    check_start,
    pose_warnings,
    rig_warnings,
)
from scas4d_core.settings import SceneSettings, Settings


def looking(centre, towards, up=(0.0, 0, 1)):
    """World to camera at `centre`, looking along `towards`."""
    z = np.asarray(towards, float) / np.linalg.norm(towards)
    x = np.cross(z, up) / np.linalg.norm(np.cross(z, up))
    pose = np.eye(4)
    pose[:3, :3] = [x, np.cross(z, x), z]
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(centre, float)
    return pose


def rig_of(poses, focal=500.0, size=(640, 480)):
    lens = [[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]
    return Rig(tuple(Camera(f"c{i}", lens, pose, *size) for i, pose in enumerate(poses)))


def inverted(rig):
    return rig_of([np.linalg.inv(camera.world_to_camera) for camera in rig.cameras])


ANGLES = np.linspace(0, 2 * np.pi, 8, endpoint=False)
RING = np.stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(8)], axis=1)
TILTS = np.array([[0, 0, z] for z in (0.4, -0.3, 0.1, -0.5, 0.2, 0.0, -0.1, 0.3)])
GRID = [(x, z) for x in (0, 0.1, 0.2) for z in (0, 0.1, 0.2)]
CLOUD = np.random.default_rng(0).uniform(-0.4, 0.4, (300, 3))

RIGS = {
    "inward": lambda o: [looking(o + 3 * r, -r - [0, 0, 0.3]) for r in RING],
    "outward": lambda o: [looking(o + r, r) for r in RING],
    "outward and tilted": lambda o: [looking(o + r, r + t) for r, t in zip(RING, TILTS, strict=True)],
    "planar array": lambda o: [looking(np.add(o, [x, 0, z]), (0, 1, 0)) for x, z in GRID],
    "array, toed in": lambda o: [looking(np.add(o, [x, 0, z]), (-0.3 * x, 1, -0.3 * z)) for x, z in GRID],
    "array, toed out": lambda o: [looking(np.add(o, [x, 0, z]), (x - 0.1, 1, z - 0.1)) for x, z in GRID],
    "stereo": lambda o: [looking(np.add(o, [x, 0, 0]), (-0.2 * x, 1, 0)) for x in (-0.1, 0.1)],
}


@pytest.mark.parametrize("origin", [(0, 0, 0), (0, 0, 1.5), (0, 0, -1.5), (3, 1, 0.5), (10, -5, 2)])
@pytest.mark.parametrize("kind", RIGS)
def test_sound_rigs_are_not_suspected(kind, origin):
    origin = np.array(origin, float)
    rig = rig_of(RIGS[kind](origin))
    assert pose_warnings(rig) == []
    before = origin + (CLOUD if kind == "inward" else np.add(CLOUD, [0, 2, 0]))
    assert pose_warnings(rig, before) == []
    check_points(rig, before)


@pytest.mark.parametrize("origin", [(0, 0, 0), (0, 0, 1.5), (3, 1, 0.5)])
def test_poses_the_wrong_way_round_are_suspected(origin):
    rig = inverted(rig_of(RIGS["inward"](np.array(origin, float))))
    (said,) = pose_warnings(rig)
    assert "the poses seem to be inverted" in said
    assert "invert them" in said
    (said,) = pose_warnings(rig, origin + CLOUD)
    assert "of the points on average, but " in said


@pytest.mark.parametrize(("unit", "warned"), [(1.0, False), (1000.0, True), (0.01, False), ("auto", False)])
def test_an_unusual_unit_is_named(unit, warned):
    said = rig_warnings(rig_of(RIGS["inward"](np.zeros(3))), SceneSettings(metres_per_unit=unit))
    assert len(said) == warned
    assert not warned or ("scene.metres_per_unit" in said[0] and "millimetres" in said[0])


@pytest.mark.parametrize(
    ("times", "shift", "warned"),
    [(1, 0, ""), (1000, 0, "rig radii away"), (1, 900, "rig radii away"), (1, -8, "the cameras see only")],
)
def test_a_cloud_of_another_world_is_named(times, shift, warned):
    """In millimetres before cameras in metres, beside them or far away."""
    cloud = times * np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3)) + (0, 0, shift)
    said = rig_warnings(rig_of(RIGS["inward"](np.zeros(3))), SceneSettings(), cloud)
    assert len(said) == bool(warned)
    assert not warned or warned in said[0]


def test_points_speak_for_two_cameras_too():
    rig = inverted(rig_of(RIGS["inward"](np.zeros(3))[::3][:2]))
    assert pose_warnings(rig) == []
    assert len(pose_warnings(rig, CLOUD)) == 1
    assert pose_warnings(rig, CLOUD[:0]) == []


def test_points_behind_all_cameras_are_refused():
    rig = rig_of(RIGS["planar array"](np.zeros(3)))
    with pytest.raises(RigError, match=r"all points are behind all cameras; .*must be inverted") as refused:
        check_points(rig, CLOUD - [0, 5, 0])
    assert (refused.value.field, refused.value.value) == ("points", "300 points")
    check_points(rig, np.concatenate([CLOUD - [0, 5, 0], np.add(CLOUD, [0, 5, 0])]))


def test_a_left_handed_frame_is_named():
    pose = np.diag([1.0, 1, -1, 1])
    with pytest.raises(CameraError, match=r"camera 'a': .* has determinant -1 \(left-handed\); flip one axis"):
        Camera("a", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], pose, 64, 48)
    with pytest.raises(CameraError, match=r"is not a rotation \(determinant -8\)"):
        Camera("a", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.diag([2.0, 2, -2, 1]), 64, 48)


@pytest.mark.parametrize(
    ("focal", "size", "scene", "field", "said"),
    [
        (
            31.0,
            (640, 480),
            {},
            "rig.cameras.0.intrinsics",
            "31 px is 0.0484 times .* pixels, 32 to 640000",
        ),
        (7e5, (640, 480), {}, "rig.cameras.0.intrinsics", "focal length 700000 px"),
        (
            500.0,
            (640, 480),
            {"image_scale": 0.01},
            "settings.scene.image_scale",
            "reduces .* to 6x5 pixels; .* at least 0.03",
        ),
        (8.0, (10, 30), {}, "rig.cameras.0", "has 10x30 pixels; use images of at least 11 pixels per side"),
        (500.0, (640, 480), {"metres_per_unit": 1e-9}, "settings.scene.metres_per_unit", "radius .*e-09 m; .*'auto'"),
        (500.0, (640, 480), {"metres_per_unit": 1e12}, "settings.scene.metres_per_unit", "radius"),
    ],
)
def test_what_cannot_work_is_refused(focal, size, scene, field, said):
    rig = rig_of(RIGS["inward"](np.zeros(3)), focal, size)
    with pytest.raises(RigError, match=said) as refused:
        check_scene(rig, SceneSettings(**scene))
    assert refused.value.field == field
    assert refused.value.remedy


@pytest.mark.parametrize(
    ("focal", "size", "scale"), [(16041.0, (960, 480), 1.0), (33.0, (640, 480), 1.0), (500.0, (640, 480), 0.023)]
)
def test_what_works_is_taken(focal, size, scale):
    """A fly's rig is all but orthographic; a quarter of a quarter of a picture is one still."""
    check_rig(rig_of(RIGS["inward"](np.zeros(3)), focal, size), SceneSettings(image_scale=scale), None)


@pytest.mark.parametrize(("count", "said"), [(1, "only one camera"), (3, "all 3 cameras are at the same position")])
def test_no_depth_without_points_or_a_baseline(count, said):
    rig = rig_of([looking((1, 2, 3), RING[i]) for i in range(count)])
    with pytest.raises(RigError, match=said) as refused:
        check_start(rig, has_points=False)
    assert refused.value.field == "points"
    check_start(rig, has_points=True)


def test_a_reconstruction_refuses_the_same_before_it_looks_at_pictures():
    rig = rig_of(RIGS["inward"](np.zeros(3)))
    frame = Frame(0, 0.0, {}, {})
    with pytest.raises(RigError, match=r"image_scale 0\.001 reduces"):
        Reconstruction.start(rig, frame, Settings(scene=SceneSettings(image_scale=0.001)))
    with pytest.raises(RigError, match="there is only one camera"):
        Reconstruction.start(Rig(rig.cameras[:1]), frame, Settings())
    behind = InitialPoints(np.full((3, 3), 50.0) * [[0], [0], [1]] + [-50, 0, 0], np.zeros((3, 3), np.float32))
    with pytest.raises(RigError, match="all points are behind all cameras"):
        Reconstruction.start(rig_of(RIGS["planar array"](np.array([0, 60.0, 0]))), frame, Settings(), points=behind)
