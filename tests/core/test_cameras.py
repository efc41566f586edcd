import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scas4d_core.cameras import Camera, CameraError, Rig, WorldFrame, rig_inside


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def camera(seed=0, name="a", centre=(0.3, -1.0, 2.0), size=(256, 192)):
    pose = np.eye(4)
    pose[:3, :3] = rotation(seed)
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(centre, float)
    return Camera(name, np.array([[425.0, 0, 120.3], [0, 430.0, 97.1], [0, 0, 1]]), pose, *size)


@given(seed=st.integers(0, 1000))
def test_unproject_undoes_project(seed):
    seen = camera(seed)
    rng = np.random.default_rng(seed)
    uv = rng.uniform(0, 256, (5, 2))
    depth = rng.uniform(0.1, 50, 5)
    again, z = seen.project(seen.unproject(uv, depth))
    np.testing.assert_allclose(again, uv, atol=1e-8)
    np.testing.assert_allclose(z, depth, rtol=1e-9)


def test_opencv_axes():
    seen = Camera("a", np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]), np.eye(4), 100, 80)
    uv, depth = seen.project([[1.0, 2.0, 4.0], [0, 0, -1.0]])
    np.testing.assert_allclose(uv[0], [75, 90])  # x right, y down
    assert depth.tolist() == [4.0, -1.0]
    assert np.isnan(uv[1]).all()
    np.testing.assert_allclose(camera(centre=(1, 2, 3)).centre, [1, 2, 3])


@pytest.mark.parametrize("scale", [0.5, 2.0, 0.4, 1 / 3])
def test_a_scaled_camera_sees_the_same_share_of_the_picture(scale):
    full = camera()
    small = full.scaled(scale)
    assert (small.width, small.height) == (round(256 * scale), round(192 * scale))
    point = full.unproject([31.0, 77.0], 3.0)
    ratio = np.array([small.width / 256, small.height / 192])
    np.testing.assert_allclose(small.project(point)[0], np.array([31.0, 77.0]) * ratio)


def test_halving_puts_the_centre_of_four_pixels_on_the_centre_of_one():
    full = camera()
    corner = full.unproject([11.0, 21.0], 3.0)  # where pixels (10, 20), (11, 20), (10, 21), (11, 21) meet
    np.testing.assert_allclose(full.scaled(0.5).project(corner)[0], [5.5, 10.5])  # the centre of pixel (5, 10)


@pytest.mark.parametrize("metres", [1.0, 0.001, "auto"])
def test_the_world_frame_leaves_projections_alone_ten_kilometres_away(metres):
    offset = np.array([7000.0, -7000.0, 150.0])
    cameras = tuple(camera(seed, str(seed), offset + np.random.default_rng(seed).normal(size=3)) for seed in range(4))
    frame = Rig(cameras).world_frame(metres)
    for outside in cameras:
        inside = frame.camera_to_inside(outside)
        points = outside.unproject(np.random.default_rng(1).uniform(0, 200, (6, 2)), np.full(6, 2.5))
        as_float32 = frame.to_inside(points).astype(np.float32)
        uv, depth = inside.project(as_float32)
        expected, expected_depth = outside.project(points)
        np.testing.assert_allclose(uv, expected, atol=1e-3)
        np.testing.assert_allclose(depth, expected_depth * frame.metres_per_unit, rtol=1e-5)
        np.testing.assert_allclose(frame.to_user(frame.to_inside(points)), points, atol=1e-9)


def test_auto_takes_the_radius_for_three_metres():
    cameras = tuple(camera(0, str(i), centre) for i, centre in enumerate([(100, 0, 0), (-100, 0, 0)]))
    rig = Rig(cameras)
    assert rig.radius == pytest.approx(110)
    assert rig.world_frame("auto").metres_per_unit == pytest.approx(3 / 110)


@pytest.mark.parametrize(("focal", "share"), [(40, 1.0), (128, 1.0), (256, 0.5), (1280, 0.1)])
def test_long_lenses_reach_a_part_of_the_scene(focal, share):
    there = np.eye(4)
    there[0, 3] = -2
    lens = [[focal, 0, 32], [0, focal, 24], [0, 0, 1]]
    rig = Rig((Camera("0", lens, np.eye(4), 64, 48), Camera("1", lens, there, 64, 48)))
    assert rig.reach == pytest.approx(share * rig.radius)


@pytest.mark.parametrize("count", [1, 3])
def test_cameras_at_one_place_take_a_scene_of_three_metres(count):
    rig = Rig(tuple(camera(seed, str(seed), (7000.0, 0.1, -70.0)) for seed in range(count)))
    assert rig.at_one_place
    inside = rig_inside(rig.world_frame(0.01), rig.cameras)
    assert inside.radius == 3.0
    with pytest.raises(CameraError, match=r"set metres_per_unit to a number.*about 3 m"):
        rig.world_frame("auto")
    apart = Rig((*rig.cameras, camera(9, "apart", (7001.0, 0.1, -70.0))))
    assert not apart.at_one_place
    assert apart.radius < 3.0


def test_poses_beyond_all_numbers_are_refused():
    rig = Rig((camera(0, "a", (1e308, 1e308, 1e308)), camera(1, "b", (-1e308, 0, 0))))
    with pytest.raises(CameraError, match="use larger units for world_to_camera"):
        rig.world_frame()


def changed(field, index, value):
    fields = {"intrinsics": camera().intrinsics.copy(), "world_to_camera": camera().world_to_camera.copy()}
    fields[field][index] = value
    return Camera("front", fields["intrinsics"], fields["world_to_camera"], 256, 192)


@pytest.mark.parametrize(
    ("field", "index", "value", "message"),
    [
        ("intrinsics", (0, 0), -1.0, "focal lengths"),
        ("intrinsics", (0, 1), 0.5, "remove any skew"),
        ("intrinsics", (1, 2), np.nan, "intrinsics contains NaN"),
        ("world_to_camera", (0, 3), np.inf, "world_to_camera contains NaN or infinity"),
        ("world_to_camera", (slice(0, 3), slice(0, 3)), np.eye(3) * 1.5, "not a rotation"),
        ("world_to_camera", (slice(0, 3), slice(0, 3)), np.diag([1, 1, -1]), r"\(left-handed\)"),
        ("world_to_camera", 3, (0, 0, 1, 1), "last row"),
    ],
)
def test_faults_name_the_camera_and_the_field(field, index, value, message):
    with pytest.raises(CameraError, match=f"'front'.*{message}"):
        changed(field, index, value)


def test_shapes_sizes_and_names():
    with pytest.raises(CameraError, match=r"shape \(3, 4\)"):
        Camera("a", camera().intrinsics, np.eye(4)[:3], 4, 4)
    with pytest.raises(CameraError, match="0x4"):
        Camera("a", camera().intrinsics, np.eye(4), 0, 4)
    with pytest.raises(CameraError, match="duplicates: a"):
        Rig((camera(0), camera(1)))
    with pytest.raises(CameraError, match="at least one"):
        Rig(())
    for metres in (0.0, -1.0, np.nan):
        with pytest.raises(CameraError, match="metres_per_unit"):
            Rig((camera(),)).world_frame(metres)


def test_a_camera_cannot_be_changed_by_the_arrays_it_came_from():
    intrinsics = camera().intrinsics.copy()
    kept = Camera("a", intrinsics, np.eye(4), 4, 4)
    intrinsics[0, 0] = 1
    assert kept.fx == 425
    with pytest.raises(ValueError, match="read-only"):
        kept.intrinsics[0, 0] = 1


def test_world_frame_round_trip():
    frame = WorldFrame(np.array([1.0, 2.0, 3.0]), 0.01)
    np.testing.assert_allclose(frame.to_inside([[101.0, 2.0, 3.0]]), [[1.0, 0, 0]])
    np.testing.assert_allclose(frame.to_user([[1.0, 0, 0]]), [[101.0, 2.0, 3.0]])
