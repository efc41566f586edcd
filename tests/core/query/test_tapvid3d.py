import numpy as np
import pytest

from scas4d_core.cameras import Camera
from scas4d_core.query.tapvid3d import tapvid3d

# The world in centimetres; the camera looks along the world's x, one metre before its origin.
TURN = np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])
POSE = np.block([[TURN, np.array([[0.0], [0], [100]])], [np.zeros((1, 3)), np.ones((1, 1))]])
CAMERA = Camera("c", np.array([[50.0, 0, 32], [0, 60, 24], [0, 0, 1]]), POSE, 64, 48)


def test_points_are_in_metres_in_the_cameras_axes_and_project_with_its_numbers():
    rng = np.random.default_rng(0)
    positions = rng.uniform(-20, 20, size=(5, 7, 3))
    positions[:, 3] = np.nan
    file = tapvid3d(positions, np.ones((5, 7), bool), CAMERA, 2, metres_per_unit=0.01)
    assert {name: (array.shape, str(array.dtype)) for name, array in file.items()} == {
        "tracks_XYZ": ((5, 7, 3), "float32"),
        "visibility": ((5, 7), "bool"),
        "queries_xyt": ((7, 3), "float32"),
        "fx_fy_cx_cy": ((4,), "float32"),
        "extrinsics_w2c": ((5, 4, 4), "float32"),
    }
    # As a reader of the format goes about it: intrinsics on the points, extrinsics from the world in metres.
    fx, fy, cx, cy = file["fx_fy_cx_cy"]
    x, y, z = np.moveaxis(file["tracks_XYZ"], -1, 0)
    uv = np.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)
    np.testing.assert_allclose(uv, CAMERA.project(positions)[0], atol=1e-3)
    world = np.concatenate([positions * 0.01, np.ones((5, 7, 1))], axis=-1)
    through = np.einsum("tij,tqj->tqi", file["extrinsics_w2c"], world)[..., :3]
    np.testing.assert_allclose(file["tracks_XYZ"], through, atol=1e-6)
    np.testing.assert_allclose(file["queries_xyt"][:, :2], uv[2], atol=1e-3)
    assert np.all(file["queries_xyt"][:, 2] == 2)


def test_a_query_frame_that_is_not_among_the_frames_is_told():
    file = tapvid3d(np.zeros((2, 1, 3)), np.ones((2, 1), bool), CAMERA, -1)
    assert np.isnan(file["queries_xyt"][0, :2]).all()
    assert file["queries_xyt"][0, 2] == -1
    given = tapvid3d(np.zeros((2, 1, 3)), np.ones((2, 1), bool), CAMERA, -1, pixels=np.array([[3.5, 4.5]]))
    assert given["queries_xyt"].tolist() == [[3.5, 4.5, -1]]


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"got \(2, 1, 3\) and \(2, 2\)"):
        tapvid3d(np.zeros((2, 1, 3)), np.ones((2, 2), bool), CAMERA, 0)
