"""TAPVid-MV: what a loader of the benchmark reads from the files, compared with the state."""

import io
import json
import zipfile

import numpy as np
import pytest
from export_cases import corner
from PIL import Image

from scas4d_core.cameras import Camera, Rig, WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.exports import export_sequence
from scas4d_core.exports.track_rows import MAX_TRACKS, evenly_spaced_moving_rows
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
    assert [path.name for path in folder.iterdir()] == ["a.zip"]
    return read(folder / "a.zip", folder / "read")


def true_visibility():
    """Visibility of all Gaussians [views, T, N]."""
    extent = moving_extent(next(states())[2])
    return np.array(
        [
            [
                visible_points(state, WORLD, WORLD.to_user(state.means), camera, extent) & state.present
                for _, _, state in states()
            ]
            for camera in RIG.cameras
        ]
    )


def test_tracks_are_the_centres_that_some_camera_sees(sequence):
    tracks, _, views = sequence
    seen = true_visibility()
    kept = seen.any(axis=(0, 1))
    assert 3 < kept.sum() < corner.COUNT
    assert kept[2]
    assert tracks.dtype == np.float32
    for k, (_, _, state) in enumerate(states()):
        expected = np.where(state.present[:, None], 0.01 * WORLD.to_user(state.means), np.nan)[kept]
        np.testing.assert_allclose(tracks[k], expected, rtol=1e-5)  # the user's unit is a centimetre
    assert np.isnan(tracks[2]).any()
    for view, visible in zip(views, seen, strict=True):
        assert view["visibility"].dtype == bool
        assert view["visibility"].tolist() == visible[:, kept].tolist()


def test_cameras_project_the_tracks_to_the_pixels_of_the_rig(sequence):
    tracks, _, views = sequence
    assert len(views) == len(RIG.cameras)
    kept = true_visibility().any(axis=(0, 1))
    for camera, view in zip(RIG.cameras, views, strict=True):
        fx, fy, cx, cy = view["intrinsics"].astype(np.float64)
        for k, (_, _, state) in enumerate(states()):
            turn, shift = view["extrinsics_w2c"][k, :3, :3], view["extrinsics_w2c"][k, :3, 3]
            x, y, z = (tracks[k].astype(np.float64) @ turn.T + shift).T
            uv = np.stack([fx * x / z + cx, fy * y / z + cy], axis=-1)
            expected, depth = camera.project(WORLD.to_user(state.means[kept]))
            there = state.present[kept]
            np.testing.assert_allclose(uv[there], expected[there] - 0.5, atol=0.01)  # the first pixel's centre is 0
            np.testing.assert_allclose(z[there], 0.01 * depth[there], rtol=1e-5)


def test_images_and_depth_are_those_of_the_renderer(sequence):
    _, _, views = sequence
    renderer = ViewRenderer(WORLD)
    for camera, view in zip(RIG.cameras, views, strict=True):
        assert view["images_jpeg_bytes"].shape == (3,)
        for k, (_, _, state) in enumerate(states()):
            expected = renderer.render(state, camera, (0, 0, 1))
            difference = image_of(view, k) / 255 - np.clip(expected.colour, 0, 1)
            assert np.sqrt((difference**2).mean()) < 0.02
            metres = np.where(np.isnan(expected.depth), 0, 0.01 * expected.depth)
            np.testing.assert_allclose(view["depth"][k], metres, rtol=1e-3, atol=1e-3)
            assert 0 < (metres > 0).mean() < 1


def image_of(view, frame):
    with Image.open(io.BytesIO(view["images_jpeg_bytes"][frame].tobytes())) as image:
        assert image.format == "JPEG"
        return np.asarray(image, np.float64)


def test_each_query_is_a_visible_frame_and_view_of_its_track(sequence):
    tracks, queries, views = sequence
    assert queries.shape == (tracks.shape[1], 4)
    assert queries.dtype == np.float32
    kept = np.flatnonzero(true_visibility().any(axis=(0, 1)))
    known = list(states())
    for n, (u, v, frame, view) in enumerate(queries):
        assert views[int(view)]["visibility"][int(frame), n]
        mean = known[int(frame)][2].means[kept[n]]
        (expected,), _ = RIG.cameras[int(view)].project(WORLD.to_user(mean[None]))
        np.testing.assert_allclose((u, v), expected - 0.5, atol=0.01)
    assert len({(frame, view) for _, _, frame, view in queries}) > 2  # drawn from all frames and views


def test_queries_are_at_the_centre_of_a_blob_in_the_image(tmp_path):
    """The centre of the first pixel is at 0: the centroid of a white blob in pixel indices is its query."""
    camera = Camera("front", [[200, 0, 20.3], [0, 200, 12.8], [0, 0, 1]], np.eye(4), 40, 30)
    state = Gaussians.of_points([[0.01, 0.02, 2]], radius=0.02, colours=[1, 1, 1])
    export_sequence(
        [(0, 0.0, state)], "tapvid-mv", tmp_path / "a.zip", world=WorldFrame(np.zeros(3)), rig=Rig((camera,))
    )
    _, queries, (view,) = read(tmp_path / "a.zip", tmp_path / "read")
    image = image_of(view, 0).mean(axis=-1)
    image[image < 20] = 0
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    centroid = [(image * axis).sum() / image.sum() for axis in (columns, rows)]
    np.testing.assert_allclose(queries[0, :2], centroid, atol=0.1)


def test_a_track_that_is_never_visible_is_omitted(tmp_path):
    camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    state = Gaussians.of_points([[0, 0, 2], [0, 0, -2]], radius=0.1)
    given = {"world": WorldFrame(np.zeros(3)), "rig": Rig((camera,))}
    export_sequence([(0, 0.0, state)], "tapvid-mv", tmp_path / "a.zip", **given)
    tracks, queries, (view,) = read(tmp_path / "a.zip", tmp_path / "read")
    np.testing.assert_allclose(tracks, [[[0, 0, 2]]], atol=1e-6)
    np.testing.assert_allclose(queries, [[31.5, 23.5, 0, 0]], atol=1e-4)
    assert view["visibility"].tolist() == [[True]]
    with pytest.raises(InputError, match="no camera ever sees any of the tracks; use other frames or ids"):
        export_sequence([(0, 0.0, state)], "tapvid-mv", tmp_path / "b.zip", ids=[1], **given)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "read"]


def test_ids_select_the_tracks(tmp_path):
    export_sequence(states(), "tapvid-mv", tmp_path / "a.zip", world=WORLD, rig=RIG, ids=[59, 52, 57, 52])
    tracks, _, _ = read(tmp_path / "a.zip", tmp_path / "read")
    first, kept = next(states())[2], true_visibility().any(axis=(0, 1))
    rows = [row for row in (2, 7, 9) if kept[row]]
    np.testing.assert_allclose(tracks[0], 0.01 * WORLD.to_user(first.means[rows]), rtol=1e-5)
    names = json.loads((tmp_path / "read" / "scas4d.json").read_text())
    assert names == {
        "cameras": list(RIG.names), "frames": [12, 13, 14], "times": [0.0, 0.04, 0.08],
        "ids": [50 + row for row in rows],
    }  # fmt: skip
    with pytest.raises(InputError, match=r"unknown Gaussian ids \[7, 999\]; use ids of the exported states"):
        export_sequence(states(), "tapvid-mv", tmp_path / "b.zip", world=WORLD, rig=RIG, ids=[999, 52, 7])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "read"]


def test_many_moving_gaussians_are_thinned_evenly():
    state = Gaussians.of_points(np.zeros((3 * MAX_TRACKS, 3)), radius=0.05)
    state = state.replace(foreground=np.repeat(np.float32([0, 1, 1]), MAX_TRACKS))
    rows = evenly_spaced_moving_rows(state)
    assert len(rows) == MAX_TRACKS
    assert (rows[0], rows[-1]) == (MAX_TRACKS, 3 * MAX_TRACKS - 1)
    assert set(np.diff(rows)) <= {1, 2, 3}
    assert len(evenly_spaced_moving_rows(state.rows(np.arange(10)))) == 0


def test_static_scenes_need_ids(tmp_path):
    still = corner.state().replace(foreground=np.zeros(corner.COUNT, np.float32))
    with pytest.raises(InputError, match="nothing moves in frame 4, but ids is None; start at a later frame, or pass"):
        export_sequence([(4, 0.0, still)], "tapvid-mv", tmp_path / "a.zip", world=WORLD, rig=RIG)
    assert not list(tmp_path.iterdir())
    row = int(np.flatnonzero(true_visibility()[:, 0].any(axis=0))[0])
    export_sequence([(4, 0.0, still)], "tapvid-mv", tmp_path / "a.zip", world=WORLD, rig=RIG, ids=[50 + row])
    assert read(tmp_path / "a.zip", tmp_path / "read")[0].shape == (1, 1, 3)


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", full)
    with pytest.raises(InputError, match=r"out '.*a\.zip' cannot be written \(No space left on device"):
        export_sequence(states(), "tapvid-mv", tmp_path / "a.zip", world=WORLD, rig=RIG)
    assert not list(tmp_path.iterdir())
