"""A plane on which pictures agree, and what lies behind the stage."""

from __future__ import annotations

import numpy as np
import pytest

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import Frame
from scas4d_core.first_frame.initial_points import initial_points
from scas4d_core.first_frame.points.plane import Plane, agreed_plane, plane_points
from scas4d_core.first_frame.points.surroundings import Stage, surroundings
from scas4d_core.first_frame.static_scene import first_trainer
from scas4d_core.posed_pictures import InitialPointsError, PosedPicture
from scas4d_core.settings import SceneSettings, StaticSettings
from scas4d_core.update.view_factory import ViewFactory

NORMAL = np.array([0.1, -0.15, 1.0]) / np.linalg.norm([0.1, -0.15, 1.0])
"""Of the table: a little tilted against the cameras' common up."""
HEIGHT, SIDE, TILE = 0.1, 0.8, 0.05
"""Metres: of the table's middle above the origin, half of its side, one tile of its pattern."""
SIZE = 96


def camera_at(angle: float) -> Camera:
    """A camera on a ring of 2.5 m that looks down at the origin."""
    centre = np.array([2 * np.cos(angle), 2 * np.sin(angle), 1.5])
    ahead = -centre / np.linalg.norm(centre)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(ahead, right), ahead])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    lens = np.array([[1.4 * SIZE, 0, SIZE / 2], [0, 1.4 * SIZE, SIZE / 2], [0, 0, 1]])
    return Camera(f"at {angle:.1f}", lens, pose, SIZE, SIZE)


def picture(camera: Camera, seed: int) -> PosedPicture:
    """The table, at another exposure for each camera, in a room of which each camera sees another part."""
    rng = np.random.default_rng(seed)
    tiles = np.random.default_rng(99).uniform(40, 200, (40, 40))
    grid = np.arange(SIZE) + 0.5
    uv = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    ray = camera.unproject(uv, np.ones(len(uv))) - camera.centre
    way = ((HEIGHT * np.array([0, 0, 1]) - camera.centre) @ NORMAL) / (ray @ NORMAL)
    across = ((camera.centre + way[:, None] * ray)[:, :2] / TILE + 20).astype(int)
    on = (way > 0) & (np.abs(across - 20) < SIDE / TILE).all(axis=1)
    room = rng.uniform(20, 230, (8, 8)).repeat(SIZE // 8, 0).repeat(SIZE // 8, 1).reshape(-1)
    table = tiles[tuple(np.where(on[:, None], across, 0).T)] * rng.uniform(0.7, 1.2)
    grey = np.where(on, table, room).reshape(SIZE, SIZE, 1).repeat(3, axis=2)
    return PosedPicture(camera, grey.clip(0, 255).astype(np.uint8))


@pytest.fixture(scope="module")
def views() -> list[PosedPicture]:
    return [picture(camera_at(angle), seed) for seed, angle in enumerate(np.arange(4) * np.pi / 2)]


@pytest.fixture(scope="module")
def cloud(views):
    rig = Rig(tuple(view.camera for view in views))
    return initial_points(rig, {view.camera.name: view.image for view in views}, {}, stereo=False)


@pytest.mark.slow
def test_the_table_is_found_that_cameras_see_from_four_sides(views):
    plane = agreed_plane(views)
    assert abs(float(plane.normal @ NORMAL)) > np.cos(0.03)
    points = plane_points(views).positions
    off = np.abs((points - [0, 0, HEIGHT]) @ NORMAL)
    assert len(points) > 300
    assert np.percentile(off, 95) < 0.03
    reach = np.abs(points[:, :2]).max(axis=1)
    assert np.percentile(reach, 95) < SIDE + 4 * TILE
    corners = np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]) * 0.6 * SIDE
    assert (np.linalg.norm(points[None, :, :2] - corners[:, None], axis=-1).min(axis=1) < 0.1).all()


def test_pictures_of_other_rooms_agree_on_no_plane(views):
    rng = np.random.default_rng(5)
    strange = [
        PosedPicture(view.camera, rng.integers(0, 255, (12, 12, 3), np.uint8).repeat(8, 0).repeat(8, 1))
        for view in views
    ]
    with pytest.raises(InitialPointsError, match="do not agree on any plane"):
        plane_points(strange)


def test_plane_is_covered_by_its_cells():
    cells = Plane(np.array([1.0, 2, 3]), np.array([0.0, 0, 1]), 2.0).cells(5)
    assert cells[2, 2] == pytest.approx([1, 2, 3])
    assert np.ptp(cells.reshape(-1, 3), axis=0) == pytest.approx([3.2, 3.2, 0])


def test_masks_label_what_lies_on_a_plane(views):
    half = np.zeros((SIZE, SIZE), bool)
    half[:, : SIZE // 2] = True
    found = plane_points([PosedPicture(view.camera, view.image, half) for view in views])
    assert found.foreground is not None
    assert 0.1 < found.foreground.mean() < 0.9


def test_surroundings_lie_beyond_the_stage_and_hardly_in_another_picture(views):
    distances = [2.5] * len(views)
    stage, found = Stage.of(views, distances), surroundings(views, distances)
    assert not stage.holds(found.positions).any()
    assert stage.holds(np.array([view.camera.centre for view in views])).all()
    each = len(found) // len(views)
    for number, view in enumerate(views):
        uv, depth = view.camera.project(found.positions)
        seen = (depth > 0) & (uv >= 0).all(axis=1) & (uv < SIZE).all(axis=1)
        assert seen[number * each : (number + 1) * each].all()
        assert seen.sum() < 1.05 * each
    first = found.positions[:each]
    column, line = views[0].camera.project(first)[0].astype(int).T
    same = np.abs(found.colours[:each] - views[0].image[line, column] / 255).max(axis=1) < 1e-6
    assert same.mean() > 0.95  # a point on the border of two pixels may come back in the other


def test_surroundings_leave_out_what_masks_hold(views):
    half = np.zeros((SIZE, SIZE), bool)
    half[:, : SIZE // 2] = True
    found = surroundings([PosedPicture(views[0].camera, views[0].image, half)], [2.5])
    assert (views[0].camera.project(found.positions)[0][:, 0] > SIZE // 2).all()
    assert found.foreground is not None
    assert not found.foreground.any()


def test_few_cameras_far_apart_get_plane_and_surroundings(cloud):
    assert cloud.method.endswith("plane + surroundings")
    assert cloud.stage is not None
    on_stage = cloud.stage.holds(cloud.positions)
    assert on_stage.sum() > 300
    assert (~on_stage).sum() > 1000


def test_surroundings_that_one_camera_sees_are_kept_and_floaters_are_not(views, cloud):
    rig = Rig(tuple(view.camera for view in views))
    frame = Frame(0, 0.0, {view.camera.name: view.image for view in views}, {})
    few = StaticSettings(iterations=30, max_gaussians=4000)

    def kept(stage: Stage | None) -> int:
        factory = ViewFactory(rig)
        trainer = first_trainer(
            factory, factory.views(frame, {}), cloud.positions, cloud.colours, None, SceneSettings(), few, stage=stage
        )
        trainer.train()
        means = trainer.gaussians().means
        assert len(means) > 100
        return int((~cloud.stage.holds(means)).sum())

    assert kept(cloud.stage) > 4 * kept(None)


def test_with_masks_every_point_has_a_label(views):
    """Where next to nothing in the masks is confirmed the volume is filled: its points are labelled like all others."""
    rig = Rig(tuple(view.camera for view in views))
    corner = np.zeros((SIZE, SIZE), np.uint8)
    corner[:30, :30] = 1  # shows the room, on which cameras do not agree
    images = {view.camera.name: view.image for view in views}
    found = initial_points(rig, images, dict.fromkeys(rig.names, corner), stereo=False)
    assert found.foreground is not None
    assert len(found.foreground) == len(found.positions)
