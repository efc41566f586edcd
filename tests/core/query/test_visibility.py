"""Visibility of points: the light that passes the Gaussians in front of them."""

from __future__ import annotations

import numpy as np
import pytest
from ray_cases import CAMERA, gaussians, random_cloud, sheet, stacked

from scas4d_core.cameras import Camera, WorldFrame
from scas4d_core.engines.limits import DEFAULT
from scas4d_core.gaussians import Gaussians, moving_extent
from scas4d_core.query import visibility
from scas4d_core.query.ray_depth import RAY_SOFTENING, REACH, RaySplats
from scas4d_core.query.visibility import OWN_SURFACE, find_visibility
from scas4d_core.storage.history import History

WORLD = WorldFrame(np.zeros(3))


def history_of(*states: Gaussians) -> History:
    history = History()
    for index, state in enumerate(states):
        history.append(index, index / 30, state)
    return history


def moved(state: Gaussians, shift: tuple[float, float, float]) -> Gaussians:
    return state.replace(means=state.means + np.float32(shift))


def at(uv: list[list[float]], depth: list[float]) -> np.ndarray:
    """[1, Q, 3] points on the rays of pixels."""
    return CAMERA.unproject(np.array(uv), np.array(depth))[None]


def test_a_point_behind_a_surface_is_hidden_and_one_on_it_is_not() -> None:
    wall = sheet((0, 0, 1), 2.0)
    own = OWN_SURFACE * moving_extent(wall)
    depth = [1.5, 2.0, 2 + 0.8 * own, 2 + 1.2 * own, 3.0]
    points = at([[32.0, 24.0]] * 5, depth)
    assert find_visibility(history_of(wall), WORLD, points, [0], CAMERA, 0).tolist() == [
        [True, True, True, False, False]
    ]


def test_only_points_in_the_image_are_visible() -> None:
    wall = sheet((0, 0, 1), 2.0)
    points = np.concatenate(
        [at([[63.9, 47.9], [64.1, 24], [32, -0.1]], [1.0] * 3), [[[0, 0, -1], [np.nan, 0, 1]]]], axis=1
    )
    assert find_visibility(history_of(wall), WORLD, points, [0], CAMERA, 0).tolist() == [[True] + [False] * 4]
    assert find_visibility(history_of(wall), WORLD, np.empty((1, 0, 3)), [0], CAMERA, 0).shape == (1, 0)


def test_each_frame_has_its_own_surfaces() -> None:
    wall = sheet((0, 0, 1), 2.0)
    history = history_of(wall, moved(wall, (5, 0, 0)), wall)
    points = np.repeat(at([[32.0, 24.0]], [3.0]), 3, axis=0)
    assert find_visibility(history, WORLD, points, [0, 1, 2], CAMERA, 0).tolist() == [[False], [True], [False]]


def test_a_hidden_point_beside_an_edge_is_hidden_and_a_visible_one_is_visible() -> None:
    """No pixel of a rendering decides, so that an edge is as sharp as its Gaussians."""
    wall = sheet((0, 0, 1), 2.0, spacing=0.005, opacity=0.9)
    left = wall.means[:, 0] < 0
    half = gaussians(wall.means[left], wall.factors[left], wall.opacities[left])
    points = at([[30.5, 24.0], [33.5, 24.0]], [3.0, 3.0])
    assert find_visibility(history_of(half), WORLD, points, [0], CAMERA, 0).tolist() == [[False, True]]


@pytest.mark.parametrize(("opacity", "visible"), [(0.3, True), (0.9, False)])
def test_visibility_depends_on_the_opacity_in_front(opacity: float, visible: bool) -> None:
    thin = gaussians([[0, 0, 2]], [np.diag([0.5, 0.5, 0.01])], [opacity])
    everywhere = stacked(thin, moved(sheet((0, 0, 1), 2.0), (0, 0, 8)))  # gives the extent
    points = at([[32.0, 24.0]], [3.0])
    assert find_visibility(history_of(everywhere), WORLD, points, [0], CAMERA, 0).tolist() == [[visible]]


def test_units_and_origin_of_the_users_world() -> None:
    wall, world = sheet((0, 0, 1), 2.0), WorldFrame(np.array([1.0, -2.0, 0.5]), metres_per_unit=0.01)
    points = at([[32.0, 24.0], [20.0, 10.0]], [1.5, 3.0])
    seen = find_visibility(history_of(wall), WORLD, points, [0], CAMERA, 0)
    pose = CAMERA.world_to_camera.copy()
    pose[:3, 3] = pose[:3, 3] / world.metres_per_unit - CAMERA.rotation @ world.origin
    camera = Camera("c", CAMERA.intrinsics, pose, CAMERA.width, CAMERA.height)
    assert find_visibility(history_of(wall), world, world.to_user(points), [0], camera, 0).tolist() == seen.tolist()
    assert seen.tolist() == [[True, False]]


def test_the_light_is_that_of_a_plain_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    cloud, rng = random_cloud(), np.random.default_rng(3)
    uv, depth = rng.uniform([1, 1], [63, 47], (200, 2)), rng.uniform(1.5, 3.2, 200)
    points = CAMERA.unproject(uv, depth)[None]
    extent = moving_extent(cloud)
    light = np.array([plain_light(cloud, extent, *each) for each in zip(uv, depth, strict=True)])
    for least in (0.1, 0.3, 0.6, 0.9):
        monkeypatch.setattr(visibility, "MIN_TRANSMITTANCE", least)
        seen = find_visibility(history_of(cloud), WORLD, points, [0], CAMERA, 0)[0]
        assert 20 < seen.sum() < 180
        np.testing.assert_array_equal(seen, light >= least)


def plain_light(state: Gaussians, extent: float, uv: np.ndarray, depth: float) -> float:
    """Product of 1 − α over the Gaussians whose absorption on the ray is in front of the point."""
    splats = RaySplats(state, CAMERA, uv[None], DEFAULT, RAY_SOFTENING * extent)
    ray = np.append((uv - splats.lens[1]) / splats.lens[0], 1)
    light = 1.0
    for i in range(len(splats.peak)):
        off = uv - splats.centre[i]
        alpha = min(DEFAULT.alpha_cap, splats.peak[i] * np.exp(-0.5 * off @ splats.conic[i] @ off))
        place = ray @ splats.precision[i] @ splats.means[i] / (ray @ splats.precision[i] @ ray)
        place = np.clip(place - splats.z[i], -REACH * splats.spread[i], REACH * splats.spread[i]) + splats.z[i]
        if alpha >= DEFAULT.alpha_floor and place < depth - OWN_SURFACE * extent:
            light *= 1 - alpha
    return light


def test_states_without_points_in_the_image_are_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    history, read = history_of(*[sheet((0, 0, 1), 2.0)] * 3), []
    states = history.gaussians

    def gaussians_of(index: int) -> Gaussians:
        read.append(index)
        return states(index)

    monkeypatch.setattr(history, "gaussians", gaussians_of)
    inside, outside = at([[32.0, 24.0]], [1.5])[0], np.array([[0.0, 0.0, -1.0]])
    points = np.stack([outside, inside, np.full((1, 3), np.nan)])
    assert find_visibility(history, WORLD, points, [0, 1, 2], CAMERA, 0).tolist() == [[False], [True], [False]]
    assert read == [0, 1]  # frame 0 defines the extent
