"""TAPVid-MV: what a loader of the benchmark reads from the files, compared with the state."""

import io
import zipfile

import numpy as np
import pytest
from export_cases import corner
from PIL import Image

from scas4d_core.cameras import Camera, Rig
from scas4d_core.errors import InputError
from scas4d_core.exports import export_sequence
from scas4d_core.exports.tapvid_mv import MAX_TRACKS
from scas4d_core.gaussians import Gaussians, moving_extent
from scas4d_core.query.view import ViewRenderer
from scas4d_core.query.visibility import visible_points

WORLD = corner.WORLD
RIG = corner.rig()


def read(path, folder):
    """Reads a sequence as the benchmark's loader does: NumPy arrays of a folder, with images as pickled arrays."""
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    views = []
    for number in sorted(int(each.name) for each in folder.iterdir() if each.is_dir()):
        names = ("images_jpeg_bytes", "depth", "visibility", "intrinsics", "extrinsics_w2c")
        views.append({name: np.load(folder / str(number) / f"{name}.npy", allow_pickle=True) for name in names})
    return np.load(folder / "tracks_xyz.npy"), np.load(folder / "queries_xytv.npy"), views


def states():
    """Ten Gaussians that move by 5 cm; the third is absent in the last frame."""
    first = corner.state()
    for k in range(3):
        moved = first.replace(means=first.means + np.float32([0.05 * k, 0, 0]))
        yield 12 + k, k / 25, moved.retire([2]) if k == 2 else moved


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tapvid")
    export_sequence(states(), "tapvid-mv", folder / "a.zip", world=WORLD, rig=RIG, background=(0, 0, 1))
    return read(folder / "a.zip", folder / "read")


def test_tracks_are_the_centres_in_metres(sequence):
    tracks, _, _ = sequence
    assert tracks.shape == (3, corner.COUNT, 3)
    assert tracks.dtype == np.float32
    for k, (_, _, state) in enumerate(states()):
        expected = 0.01 * WORLD.to_user(state.means)  # the user's unit is a centimetre
        present = state.present
        np.testing.assert_allclose(tracks[k, present], expected[present], rtol=1e-5)
        assert np.isnan(tracks[k, ~present]).all()


def test_projected_tracks_agree_with_the_rendered_depth_and_the_cameras(sequence):
    tracks, _, views = sequence
    assert len(views) == len(RIG.cameras)
    near = 0
    for camera, view in zip(RIG.cameras, views, strict=True):
        fx, fy, cx, cy = view["intrinsics"].astype(np.float64)
        for k, (_, _, state) in enumerate(states()):
            turn, shift = view["extrinsics_w2c"][k, :3, :3], view["extrinsics_w2c"][k, :3, 3]
            x, y, z = (tracks[k].astype(np.float64) @ turn.T + shift).T
            uv = np.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)
            expected, depth = camera.project(WORLD.to_user(state.means))
            there = state.present
            np.testing.assert_allclose(uv[there], expected[there], atol=0.01)
            np.testing.assert_allclose(z[there], 0.01 * depth[there], rtol=1e-5)
            for q in np.flatnonzero(view["visibility"][k]):
                column, row = uv[q].astype(int)
                drawn = view["depth"][k, row, column]
                near += drawn > 0 and abs(drawn - z[q]) < 0.2
    assert near >= 20


def test_images_and_depth_are_those_of_the_renderer(sequence):
    _, _, views = sequence
    renderer = ViewRenderer(WORLD)
    for camera, view in zip(RIG.cameras, views, strict=True):
        assert view["images_jpeg_bytes"].shape == (3,)
        for k, (_, _, state) in enumerate(states()):
            expected = renderer.render(state, camera, (0, 0, 1))
            with Image.open(io.BytesIO(view["images_jpeg_bytes"][k].tobytes())) as image:
                assert image.format == "JPEG"
                difference = np.asarray(image, np.float64) / 255 - np.clip(expected.colour, 0, 1)
            assert np.sqrt((difference**2).mean()) < 0.02
            metres = np.where(np.isnan(expected.depth), 0, 0.01 * expected.depth)
            np.testing.assert_allclose(view["depth"][k], metres, rtol=1e-3, atol=1e-3)
            assert 0 < (metres > 0).mean() < 1


def test_visibility_and_queries(sequence):
    tracks, queries, views = sequence
    seen = np.stack([view["visibility"] for view in views])
    assert seen.dtype == bool
    extent = moving_extent(next(states())[2])
    for camera, each in zip(RIG.cameras, seen, strict=True):
        for k, (_, _, state) in enumerate(states()):
            expected = visible_points(state, WORLD, WORLD.to_user(state.means), camera, extent) & state.present
            assert each[k].tolist() == expected.tolist()
    assert 0.1 < seen.mean() < 0.9
    assert queries.shape == (corner.COUNT, 4)
    for n, (u, v, frame, view) in enumerate(queries):
        if seen[:, :, n].any():
            assert seen[int(view), int(frame), n]
            uv, _ = RIG.cameras[int(view)].project(tracks[int(frame), n] / 0.01)
            np.testing.assert_allclose((u, v), uv, atol=0.01)
        else:
            assert [u, v, frame, view] == [-1, -1, 0, 0]
    assert len({(frame, view) for _, _, frame, view in queries}) > 2  # drawn from all frames and views


def test_a_track_that_is_never_visible_has_no_query(tmp_path):
    camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    state = Gaussians.of_points([[0, 0, 2], [0, 0, -2]], radius=0.1)
    world = Rig((camera,)).world_frame(1.0)
    inside = state.replace(means=world.to_inside(state.means).astype(np.float32))
    export_sequence([(0, 0.0, inside)], "tapvid-mv", tmp_path / "a.zip", world=world, rig=Rig((camera,)))
    tracks, queries, _ = read(tmp_path / "a.zip", tmp_path / "read")
    np.testing.assert_allclose(tracks[0], [[0, 0, 2], [0, 0, -2]], atol=1e-6)
    np.testing.assert_allclose(queries, [[32, 24, 0, 0], [-1, -1, 0, 0]], atol=1e-4)


def test_ids_select_the_tracks_and_many_are_thinned(tmp_path):
    export_sequence(states(), "tapvid-mv", tmp_path / "a.zip", world=WORLD, rig=RIG, ids=[57, 52, 999])
    tracks, _, _ = read(tmp_path / "a.zip", tmp_path / "read")
    first = next(states())[2]
    np.testing.assert_allclose(tracks[0, :2], 0.01 * WORLD.to_user(first.means[[2, 7]]), rtol=1e-5)
    assert np.isnan(tracks[:, 2]).all()  # no such Gaussian

    rows = np.random.default_rng(0).normal(size=(MAX_TRACKS + 100, 3)) + np.array([0, 0, 4])
    many = Gaussians.of_points(rows, radius=0.05)
    export_sequence([(0, 0.0, many)], "tapvid-mv", tmp_path / "b.zip", world=WORLD, rig=RIG)
    tracks, queries, _ = read(tmp_path / "b.zip", tmp_path / "more")
    assert tracks.shape[1] == len(queries) == MAX_TRACKS


def test_static_scenes_need_ids(tmp_path):
    still = corner.state().replace(foreground=np.zeros(corner.COUNT, np.float32))
    with pytest.raises(InputError, match="no Gaussian of the first frame moves; pass the ids"):
        export_sequence([(0, 0.0, still)], "tapvid-mv", tmp_path / "a.zip", world=WORLD, rig=RIG)
    assert not list(tmp_path.iterdir())
    export_sequence([(0, 0.0, still)], "tapvid-mv", tmp_path / "a.zip", world=WORLD, rig=RIG, ids=[50])
    assert read(tmp_path / "a.zip", tmp_path / "read")[0].shape == (1, 1, 3)
