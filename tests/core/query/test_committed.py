"""Reading a history: depth, background, parts and exports, in a user's world that is not the inside one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_scene import MOVING, SIZE, held_out_camera, make_box, moved, photograph

from scas4d_core.cameras import Camera, WorldFrame, rig_inside
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.committed import CommittedScene
from scas4d_core.query.ply import read_ply
from scas4d_core.storage.history import History, HistoryError

WORLD = WorldFrame(np.array([4.0, -7.0, 11.0]), 0.25)
"""A user's unit is 25 cm, the origin is elsewhere."""
OUTSIDE = WorldFrame(-WORLD.origin * WORLD.metres_per_unit, 1 / WORLD.metres_per_unit)
"""From the inside world back to the user's."""


def user_camera(camera: Camera) -> Camera:
    return rig_inside(OUTSIDE, [camera]).cameras[0]


def plane(normal: np.ndarray, through: np.ndarray, half: float = 0.5, count: int = 60) -> Gaussians:
    """Flat opaque Gaussians on a square of a plane, left half red, right half green; inside world."""
    x = np.cross([0.0, 1.0, 0.0], normal)
    x /= np.linalg.norm(x)
    y = np.cross(normal, x)
    line = np.linspace(-half, half, count)
    a, b = (array.ravel() for array in np.meshgrid(line, line))
    means = through + a[:, None] * x + b[:, None] * y
    width = 1.0 * (line[1] - line[0])
    factors = np.tile(np.stack([x * width, y * width, normal * 1e-3], axis=1), (len(means), 1, 1))
    total = len(means)
    return Gaussians(
        means=means.astype(np.float32),
        factors=factors.astype(np.float32),
        rotations=np.tile(np.float32([1, 0, 0, 0]), (total, 1)),
        opacities=np.full(total, 0.9, np.float32),
        colours=np.where(a[:, None] < 0, [1.0, 0, 0], [0, 1.0, 0]).astype(np.float32),
        foreground=np.ones(total, np.float32),
        ids=np.arange(total, dtype=np.int64),
    )


def committed(*states: Gaussians) -> CommittedScene:
    history = History()
    for index, state in enumerate(states):
        history.append(index, index / 30, state)
    return CommittedScene(history, WORLD)


@pytest.mark.parametrize(("normal", "bias"), [([0.0, 0, -1], 1e-4), ([0.3, 0.1, -1], 0.008), ([-0.5, 0.4, -1], 0.016)])
def test_depth_of_a_plane_is_its_depth_in_the_users_units(normal: list[float], bias: float) -> None:
    """A Gaussian has one depth, its centre's, and nearer ones weigh more: tilted surfaces come out a little near."""
    n = np.array(normal) / np.linalg.norm(normal)
    through = np.array([0.0, 0, 1.5])
    camera = Camera("c", np.array([[60.0, 0, 24], [0, 62, 17], [0, 0, 1]]), np.eye(4), 48, 36)
    view = committed(plane(n, through)).render(user_camera(camera))
    v, u = np.mgrid[:36, :48] + 0.5
    rays = np.stack([(u - 24) / 60, (v - 17) / 62, np.ones_like(u)], axis=-1)
    truth = (n @ through) / (rays @ n) / WORLD.metres_per_unit
    covered = view.alpha > 0.99
    assert covered.mean() > 0.3
    error = view.depth[covered] / truth[covered] - 1
    assert error.max() < 5e-3
    assert np.quantile(error, 0.01) > -1.2 * bias
    assert -bias < np.median(error) < 1e-4
    assert np.isnan(view.depth[view.alpha < 0.5]).all()
    assert np.isfinite(view.depth[view.alpha >= 0.5]).all()


def test_behind_everything_is_the_background() -> None:
    camera = user_camera(held_out_camera())
    scene = committed(make_box())
    black, blue = scene.render(camera), scene.render(camera, background=(0.1, 0.2, 0.9))
    np.testing.assert_array_equal(black.alpha, blue.alpha)
    empty = black.alpha == 0
    assert empty.any()
    np.testing.assert_array_equal(blue.colour[empty], np.tile(np.float32([0.1, 0.2, 0.9]), (empty.sum(), 1)))
    np.testing.assert_array_equal(black.colour[empty], 0)
    see_through = (1 - black.alpha[..., None]) * np.float32([0.1, 0.2, 0.9])
    np.testing.assert_allclose(blue.colour, black.colour + see_through, atol=1e-5)
    np.testing.assert_array_equal(blue.depth, black.depth)


def test_a_view_is_what_the_camera_of_the_inside_world_sees() -> None:
    box = make_box()
    view = committed(box).render(user_camera(held_out_camera()))
    truth, _ = photograph(box, held_out_camera())
    assert view.colour.shape == (SIZE, SIZE, 3)
    assert view.colour.dtype == view.alpha.dtype == view.depth.dtype == np.float32
    np.testing.assert_allclose(view.colour.clip(0, 1), truth / 255, atol=1e-2)
    assert view.parts is None


def test_views_do_not_share_buffers_and_the_newest_frame_is_the_default() -> None:
    box = make_box()
    scene = committed(box, moved(box))
    camera = user_camera(held_out_camera())
    first, newest, second = scene.render(camera, 0), scene.render(camera), scene.render(camera, 1)
    np.testing.assert_array_equal(newest.colour, second.colour)
    assert np.abs(first.colour - newest.colour).max() > 0.1
    again = scene.render(camera, 0)
    np.testing.assert_array_equal(first.colour, again.colour)
    np.testing.assert_array_equal(first.depth, again.depth)
    with pytest.raises(HistoryError, match="frame 7 is not in the history"):
        scene.render(camera, 7)


@pytest.mark.parametrize("count", [2, 5])
def test_parts_are_painted_where_their_gaussians_are(count: int) -> None:
    camera = Camera("c", np.array([[60.0, 0, 24], [0, 60, 18], [0, 0, 1]]), np.eye(4), 48, 36)
    state = plane(np.array([0.0, 0, -1]), np.array([0.0, 0, 1.5]), half=0.4)
    labels = np.where(state.colours[:, 0] > 0, 0, count - 1)
    lower = state.means[:, 1] > 0.2
    labels[lower] = -1
    view = committed(state).render(user_camera(camera), labels=labels)
    assert view.parts is not None
    assert view.parts.dtype == np.uint8
    assert view.parts.shape == (36, 48)
    np.testing.assert_array_equal(view.parts[view.alpha < 0.5], 0)
    red, green = view.colour[..., 0] > 0.9, view.colour[..., 1] > 0.9
    upper = np.arange(36)[:, None] + 0.5 < 18 + 60 * 0.2 / 1.5 - 1
    assert set(view.parts[red & upper]) == {1}
    assert set(view.parts[green & upper]) == {count}
    below = (np.arange(36)[:, None] + 0.5 > 18 + 60 * 0.2 / 1.5 + 1) & (view.alpha > 0.9)
    assert below.any()
    assert set(view.parts[below]) == {0}


@pytest.mark.parametrize(
    ("shape", "value"), [((2,), 0), ((449,), 0), ((448,), -2), ((448,), 255), ((448, 2), 0)], ids=str
)
def test_labels_that_do_not_fit_are_refused(shape: tuple[int, ...], value: int) -> None:
    """Another shape, no label, or more parts than an 8-bit picture tells apart."""
    scene = committed(make_box())
    with pytest.raises(ValueError, match="labels"):
        scene.render(user_camera(held_out_camera()), labels=np.full(shape, value))


def test_ply_is_in_the_users_world(tmp_path: Path) -> None:
    box = make_box()
    scene = committed(box, moved(box))
    scene.write_ply(tmp_path / "one.ply", 0)
    scene.write_ply(tmp_path / "newest.ply")
    one, newest = read_ply(tmp_path / "one.ply"), read_ply(tmp_path / "newest.ply")
    np.testing.assert_allclose(one.means, WORLD.to_user(box.means), atol=1e-5)
    np.testing.assert_allclose(newest.means, WORLD.to_user(moved(box).means), atol=1e-5)
    covariances = box.factors @ np.swapaxes(box.factors, 1, 2) / WORLD.metres_per_unit**2
    np.testing.assert_allclose(one.covariances(), covariances, atol=1e-5 * covariances.max())


def test_tracks_through_pixels_follow_the_surface() -> None:
    box = make_box()
    scene = committed(box, moved(box))
    camera = user_camera(held_out_camera())
    uv = np.array([[24.0, 24.0], [20.5, 22.5], [1.0, 1.0]])
    tracks = scene.tracks_of_pixels(camera, uv, 0, [0, 1])
    assert np.isnan(tracks.positions[:, 2]).all()
    assert np.all(tracks.confidence[:, 2] == 0)
    back, _ = camera.project(tracks.positions[0, :2])
    np.testing.assert_allclose(back, uv[:2], atol=0.05)
    before, after = (WORLD.to_inside(tracks.positions[t, :2]) for t in (0, 1))
    truth = moved(box.replace(means=np.resize(before, (len(box), 3)).astype(np.float32))).means[:2]
    np.testing.assert_allclose(after, truth, atol=2e-3)
    assert camera.name in scene.with_visibility(tracks, camera, 0).visibility


def test_tracks_of_ids_are_the_means_in_the_users_world() -> None:
    box = make_box()
    tracks = committed(box, moved(box)).tracks_of_ids(np.array([5, 2]), [1, 0])
    np.testing.assert_allclose(tracks.positions[0], WORLD.to_user(moved(box).means[[5, 2]]))
    np.testing.assert_allclose(tracks.positions[1], WORLD.to_user(box.means[[5, 2]]))


def test_views_with_parts_where_gaussians_were_born_later() -> None:
    box, camera = make_box(), user_camera(held_out_camera())
    scene = committed(box)
    before = scene.render(camera, labels=np.zeros(len(box), np.int64))
    first = scene.history.indices[-1]
    scene.history.append(first + 1, 1.0, box.concatenate(box.rows(np.arange(40))).retire(np.arange(MOVING)))
    after = scene.render(camera, first, labels=np.zeros(len(box) + 40, np.int64))
    np.testing.assert_array_equal(before.colour, after.colour)
    np.testing.assert_array_equal(before.parts, after.parts)
    gone = scene.render(camera)
    assert not np.array_equal(gone.alpha, after.alpha)
    there = scene.history.newest.present
    alone = committed(box.concatenate(box.rows(np.arange(40))).rows(there)).render(camera)
    np.testing.assert_array_equal(gone.colour, alone.colour)
