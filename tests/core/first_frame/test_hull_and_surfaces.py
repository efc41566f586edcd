from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scas4d_core.first_frame.points.silhouettes import plain_background, silhouette
from scas4d_core.first_frame.points.surfaces import PatchPlane, Sphere, fit_surfaces, sample_surfaces, snap_to_points
from scas4d_core.first_frame.points.visual_hull import carve, count_contradictions
from scas4d_core.posed_pictures import PosedPicture

RADIUS = 0.45


def test_hull_of_a_ball_has_its_volume_and_holds_it(scene):
    hull = carve(scene.ball_views(), voxel_pixels=1)
    true = 4 / 3 * np.pi * RADIUS**3
    # Two rings of cameras leave caps at the poles; voxels keep half a pixel more all round.
    assert true < hull.volume < 1.25 * true
    inside = np.random.default_rng(0).normal(size=(500, 3))
    inside *= RADIUS * 0.97 / np.linalg.norm(inside, axis=1, keepdims=True)
    assert hull.is_near(inside).all()
    assert not hull.is_near(inside * 1.6).any()
    radius = np.linalg.norm(hull.centres[hull.surface()], axis=1)
    assert abs(np.median(radius) - RADIUS) < 1.5 * hull.voxel


def test_surface_is_a_shell(scene):
    hull = carve(scene.ball_views(), voxel_pixels=2)
    surface = hull.surface()
    assert np.linalg.norm(hull.centres[~surface], axis=1).max() < np.linalg.norm(hull.centres, axis=1).max()
    cells = {tuple(cell) for cell in hull.cells}
    for cell, bare in zip(hull.cells[::37], surface[::37], strict=True):
        neighbours = [tuple(cell + step) in cells for step in np.vstack([np.eye(3, dtype=int), -np.eye(3, dtype=int)])]
        assert bare == (not all(neighbours))


def test_a_camera_that_cannot_see_a_point_says_nothing_about_it(scene):
    views = scene.ball_views()
    whole = carve(views, voxel_pixels=2)
    cut = views[0].camera
    narrow = PosedPicture(
        type(cut)(cut.name, cut.intrinsics, cut.world_to_camera, 60, 128),
        views[0].image[:, :60].copy(),
        None if views[0].mask is None else views[0].mask[:, :60].copy(),
    )
    clipped = carve([narrow, *views[1:]], voxel_pixels=2)
    assert whole.volume <= clipped.volume < 1.02 * whole.volume


def test_one_ragged_mask_in_twenty_four_is_outvoted_only_where_allowed(scene):
    views = scene.ball_views()
    views[0] = replace(views[0], mask=np.zeros((128, 128), bool))
    assert len(carve(views, voxel_pixels=2).cells) == 0
    assert carve(views, voxel_pixels=2, misses=0.05).volume > 0.38


def test_background_before_the_foreground_is_contradicted(scene):
    views = scene.ball_views()
    hull = carve(views, voxel_pixels=2)
    points = np.array([[0.0, 0.0, 0.0], [RADIUS + 0.07, 0.0, 0.0], [0.0, 0.0, 5.0]])
    against = count_contradictions(views, hull, points, 0.0)
    assert against[0] == 0
    assert against[1] >= 2
    assert against[2] == 0


def _picture(background: int) -> np.ndarray:
    image = np.full((40, 50, 3), background, np.uint8)
    image[10:30, 15:35] = 200
    return image


def test_plain_background_is_found_and_the_object_cut_out(scene):
    camera = scene.ring(2).cameras[0]
    camera = type(camera)("c", camera.intrinsics, camera.world_to_camera, 50, 40)
    views = [PosedPicture(camera, _picture(30)), PosedPicture(camera, _picture(33))]
    background = plain_background(views)
    assert background is not None
    assert np.abs(background.astype(int) - 31).max() <= 2
    image = _picture(30)
    image[15:17, 20:23] = 30  # dark texture
    image[20:28, 20:28] = 30  # a hole
    mask = silhouette(image, background)
    assert mask[15:17, 20:23].all()
    assert not mask[20:28, 20:28].any()
    assert mask.sum() == 400 - 64


def test_a_room_is_no_plain_background(scene):
    camera = scene.ring(2).cameras[0]
    camera = type(camera)("c", camera.intrinsics, camera.world_to_camera, 50, 40)
    room = _picture(30)
    room[:, :10] = 90
    assert plain_background([PosedPicture(camera, _picture(30)), PosedPicture(camera, room)]) is None


def _dome(count: int) -> np.ndarray:
    """Points on a floor at y = 0.8 and on the dome of radius 3 above it."""
    rng = np.random.default_rng(2)
    shell = rng.normal(size=(8 * count, 3))
    shell *= 3.0 / np.linalg.norm(shell, axis=1, keepdims=True)
    shell = shell[shell[:, 1] < 0.8][:count]
    disc = np.sqrt(rng.uniform(0, 1, count)) * 2.8
    angle = rng.uniform(0, 2 * np.pi, count)
    floor = np.stack([disc * np.cos(angle), np.full(count, 0.8), disc * np.sin(angle)], -1)
    return np.concatenate([shell, floor]) + rng.normal(0, 0.005, (len(shell) + count, 3))


def test_floor_and_dome_are_found_among_wrong_points(scene):
    centres = np.array([camera.centre for camera in scene.ring(12).cameras])
    centres[:, 1] = -np.abs(centres[:, 1])
    rng = np.random.default_rng(1)
    wrong = rng.uniform(-1.5, 0.7, (80, 3))
    found = fit_surfaces(np.concatenate([_dome(120), wrong]), centres, 0.03, most=3, seed=0)
    kinds = {type(support.surface) for support in found}
    assert kinds == {PatchPlane, Sphere}
    assert len(found) == 2
    for support in found:
        if isinstance(support.surface, Sphere):
            assert support.surface.radius == pytest.approx(3.0, abs=0.02)
            assert support.surface.centre == pytest.approx(np.zeros(3), abs=0.03)
        elif isinstance(support.surface, PatchPlane):
            assert np.abs(support.surface.normal[1]) == pytest.approx(1.0, abs=1e-3)


def test_no_surface_where_points_support_none(scene):
    centres = np.array([camera.centre for camera in scene.ring(12).cameras])
    scattered = np.random.default_rng(3).uniform(-1, 1, (300, 3))
    assert fit_surfaces(scattered, centres, 0.02, most=3, seed=0) == []


def test_samples_are_the_first_surface_and_settle_on_what_was_measured(scene):
    rig = scene.ring(12)
    views = [PosedPicture(c, np.zeros((128, 128, 3), np.uint8)) for c in rig.cameras if c.centre[1] < 0]
    centres = np.array([view.camera.centre for view in views])
    found = fit_surfaces(_dome(200), centres, 0.03, most=2, seed=0)
    samples = sample_surfaces(views, found, 8, rig.radius)
    assert len(samples) > 500
    assert samples[:, 1].max() < 0.85
    on_floor = np.abs(samples[:, 1] - 0.8) < 0.02
    assert np.linalg.norm(samples[~on_floor], axis=1) == pytest.approx(np.full((~on_floor).sum(), 3.0), abs=0.05)
    raised = samples[on_floor] - (0, 0.05, 0)
    settled = snap_to_points(samples[on_floor], found, raised, 0.2)
    assert np.median(settled[:, 1]) == pytest.approx(0.75, abs=0.01)
