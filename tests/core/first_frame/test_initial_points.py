from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import InitialPoints
from scas4d_core.first_frame.initial_points import ENOUGH_COVERAGE, image_coverage, initial_points, merge_points
from scas4d_core.first_frame.points.stereo import DepthMap, count_violations, fused_points
from scas4d_core.first_frame.points.triangulation import extract_features, fundamental_matrix, triangulate
from scas4d_core.first_frame.time_limit import TimeLimit
from scas4d_core.posed_pictures import (
    InitialPointsError,
    PosedPicture,
    collect_views,
    halved,
    look_at_point,
    observe,
    pixels_inside,
    visible_from,
)

HALF = np.array([0.5, 0.35, 0.4])
PIXEL = 2.6 / 190.0
"""World units across one pixel at the middle of the stage."""


@pytest.fixture(scope="module")
def box(scene) -> tuple[Rig, dict[str, np.ndarray], dict[str, np.ndarray]]:
    rig = scene.ring(14)
    pairs = {camera.name: scene.picture(camera) for camera in rig.cameras}
    return rig, {name: image for name, (image, _) in pairs.items()}, {name: mask for name, (_, mask) in pairs.items()}


@pytest.fixture(scope="module")
def cloud(box):
    rig, images, _ = box
    return initial_points(rig, images, {})


def test_points_lie_on_the_box_and_cover_it(scene, cloud):
    distance = scene.distance_to_box(cloud.positions)
    assert np.percentile(distance, [50, 95]) == pytest.approx([0, 0], abs=1.2 * PIXEL)
    assert np.median(distance) < 0.35 * PIXEL
    gap = cKDTree(cloud.positions).query(scene.points_on_box(2000))[0]
    assert np.percentile(gap, 95) < 3 * PIXEL


@pytest.mark.slow
def test_cameras_of_unlike_sizes_are_compared_by_stereo(scene, box, cloud):
    """Every second camera is cut by some pixels at the right, every fourth at the bottom: the cloud stays as dense."""
    rig, images, _ = box
    cut = {}
    for number, camera in enumerate(rig.cameras):
        width, height = camera.width - 8 * (number % 2), camera.height - 10 * (number % 4 == 2)
        cut[camera.name] = replace(camera, width=width, height=height)
    unlike = Rig(tuple(cut.values()))
    assert len({(camera.width, camera.height) for camera in unlike.cameras}) == 3
    pictures = {name: image[: cut[name].height, : cut[name].width] for name, image in images.items()}
    found = initial_points(unlike, pictures, {})
    assert len(found) > 0.9 * len(cloud)
    assert np.percentile(scene.distance_to_box(found.positions), 95) < 1.2 * PIXEL
    gap = cKDTree(found.positions).query(scene.points_on_box(2000))[0]
    assert np.percentile(gap, 95) < 3 * PIXEL


def test_colours_are_those_of_the_surface(scene, cloud):
    assert cloud.colours.dtype == np.float32
    assert np.abs(cloud.colours - scene.texture(cloud.positions)).mean() < 0.06


def test_without_masks_nobody_said_what_is_foreground(cloud):
    assert cloud.foreground is None


def test_masks_label_the_points(box):
    rig, images, masks = box
    labelled = initial_points(rig, images, masks, stereo_iterations=2)
    assert labelled.foreground is not None
    assert (labelled.foreground > 0.5).mean() > 0.95


@pytest.mark.slow
def test_same_seed_same_points(box):
    rig, images, _ = box
    one, two = (initial_points(rig, images, {}, stereo_iterations=1, seed=4) for _ in range(2))
    assert np.array_equal(one.positions, two.positions)
    assert np.array_equal(one.colours, two.colours)


class Ticking:
    """A clock that goes on by so many seconds whenever it is read."""

    def __init__(self, tick):
        self.now, self.tick = 0.0, tick

    def __call__(self):
        self.now += self.tick
        return self.now


def test_with_time_enough_the_points_are_those_without_a_limit(box, cloud):
    rig, images, _ = box
    found = initial_points(rig, images, {}, limit=(limit := TimeLimit(1e6, Ticking(0.01))))
    assert np.array_equal(found.positions, cloud.positions)
    assert limit.shortened == []


@pytest.mark.parametrize(
    ("tick", "said"),
    [
        (0.3, ["stereo on images at most 320 pixels wide, with 2 rounds"]),
        (0.6, ["no stereo"]),
        (1.4, ["features extracted from images downscaled to 1/2", "features matched in", "no stereo"]),
        (4.0, ["features extracted from images downscaled to 1/4", "features matched in", "no stereo"]),
    ],
)
def test_the_shorter_the_time_the_less_finely_points_are_looked_for(scene, box, cloud, tick, said):
    """By the pace on the first picture, the first pairs, and small pictures; nothing is begun and then broken off."""
    rig, images, _ = box
    found = initial_points(rig, images, {}, limit=(limit := TimeLimit(100.0, Ticking(tick))))
    assert len(limit.shortened) == len(said)
    assert all(text.startswith(start) for text, start in zip(limit.shortened, said, strict=True))
    assert found.coverage > 0.5 * cloud.coverage
    assert np.median(scene.distance_to_box(found.positions)) < 2 * PIXEL


def test_features_of_smaller_pictures_lie_where_those_of_whole_ones_do(box):
    rig, images, _ = box
    views = collect_views(rig, images, {})[:2]
    extracted = [extract_features(views, limit) for limit in (None, TimeLimit(10.0, Ticking(0.7)))]
    whole, small = ((found[0][0], found[1][0]) for found in extracted)
    for many, few in zip(whole, small, strict=True):
        assert 5 < len(few) < len(many)
        assert np.median(cKDTree(many).query(few)[0]) < 1.5


def test_budget_of_points_is_kept(box):
    rig, images, _ = box
    few = initial_points(rig, images, {}, stereo=False, max_points=300)
    assert 100 < len(few) <= 300


def test_triangulation_has_no_half_pixel_offset(scene, box):
    rig, images, _ = box
    found = triangulate(collect_views(rig, images, {}))
    assert len(found.positions) > 60
    assert found.views.sum(1).min() >= 3
    assert np.median(found.error) < 0.3
    assert np.median(scene.distance_to_box(found.positions)) < 0.2 * PIXEL


def test_fundamental_matrix_holds_for_projections(scene):
    one, two = scene.ring(4).cameras[:2]
    points = scene.points_on_box(20)
    a, b = (np.hstack([camera.project(points)[0], np.ones((20, 1))]) for camera in (one, two))
    lines = a @ fundamental_matrix(one, two).T
    distance = (lines * b).sum(1) / np.linalg.norm(lines[:, :2], axis=1)
    assert np.abs(distance).max() < 1e-6


def _flat_maps(depths: list[float]) -> list[DepthMap]:
    """Cameras side by side that look along z and all but agree on a wall at z = 3; agreement counted by hand."""
    maps = []
    agree = sum(abs(depth - 3) < 0.01 for depth in depths) - 1
    for i, depth in enumerate(depths):
        pose = np.eye(4)
        pose[0, 3] = -0.2 * i
        camera = Camera(f"c{i}", np.array([[60.0, 0, 20], [0, 60.0, 20], [0, 0, 1]]), pose, 40, 40)
        view = PosedPicture(camera, np.zeros((40, 40, 3), np.uint8))
        others = agree if abs(depth - 3) < 0.01 else 0
        maps.append(DepthMap(view, np.full((40, 40), depth), np.full((40, 40), others)))
    return maps


def test_a_point_seen_by_one_camera_only_is_refused():
    assert len(fused_points(_flat_maps([3.0, 5.0, 7.0]), 3)) == 0
    assert len(fused_points(_flat_maps([3.0, 3.0, 3.0]), 3)) == 3 * 1600


def test_two_cameras_do_not_outvote_min_views():
    assert len(fused_points(_flat_maps([3.0, 3.0, 7.0]), 3)) == 0


def test_what_cameras_look_through_is_found():
    maps = _flat_maps([3.0, 3.0, 3.0])
    points = np.array([[0.2, 0.0, 2.0], [0.2, 0.0, 3.0], [0.2, 0.0, 3.5], [90.0, 0.0, 2.0]])
    assert count_violations(maps, points, 3).tolist() == [3, 0, 0, 0]


def test_halved_pictures_keep_their_geometry(scene):
    camera = scene.ring(2, size=65).cameras[0]
    view = halved(PosedPicture(camera, np.zeros((65, 65, 3), np.uint8), np.ones((65, 65), bool)), 40)
    assert (view.camera.width, view.image.shape) == (32, (32, 32, 3))
    point = np.array([0.1, -0.2, 0.05])
    assert view.camera.project(point)[0] == pytest.approx(camera.project(point)[0] / 2)


def test_hidden_points_are_not_seen_and_colours_are_medians(scene):
    rig = scene.ring(6)
    views = [PosedPicture(c, np.full((128, 128, 3), 40 * i, np.uint8)) for i, c in enumerate(rig.cameras)]
    points = scene.points_on_box(20_000)
    visible = visible_from(views, points, 0.02)
    for row, camera in zip(visible, rig.cameras, strict=True):
        uv, depth = camera.project(points)
        face = np.abs(points / HALF).argmax(1)
        towards = (camera.centre - points) / np.linalg.norm(camera.centre - points, axis=1, keepdims=True)
        in_front = depth <= scene.box_depth(camera, uv) + 1e-6
        in_front &= np.abs(towards[np.arange(len(points)), face]) > np.cos(np.radians(55))
        assert (row[in_front]).mean() > 0.97
        deep = depth > scene.box_depth(camera, uv) + 0.25
        assert row[deep].mean() < 0.02
    seen = observe(
        views, points[:3], np.array([[1, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]], bool)
    )
    assert seen.count.tolist() == [3, 1, 0]
    assert seen.colours[0] == pytest.approx(np.full(3, 40 / 255))
    assert np.isnan(seen.colours[2]).all()


def test_look_at_point_is_where_the_axes_meet(scene):
    offset = np.array([10.0, -3.0, 4.0])
    rig = scene.ring(6, offset=offset)
    centred = [
        PosedPicture(Camera(c.name, np.array([[190.0, 0, 64], [0, 190.0, 64], [0, 0, 1]]), c.world_to_camera, 128, 128),
             np.zeros((128, 128, 3), np.uint8))
        for c in rig.cameras
    ]  # fmt: skip
    assert look_at_point(centred) == pytest.approx(offset, abs=1e-5)


def test_wrong_size_and_too_few_pictures_are_named(box):
    rig, images, masks = box
    with pytest.raises(InitialPointsError, match=r"images\['c0'\].*\(128, 128, 3\)"):
        initial_points(rig, {**images, "c0": images["c0"][:64]}, {})
    with pytest.raises(InitialPointsError, match=r"masks\['c1'\].*\(128, 128\)"):
        initial_points(rig, images, {"c1": masks["c1"][:, :9]})
    with pytest.raises(InitialPointsError, match="1 of the rig's 14 cameras"):
        initial_points(rig, {"c3": images["c3"]}, {})


def test_silhouettes_are_found_before_a_backdrop_that_does_not_reach_all_borders(scene):
    rig = scene.ring(5)
    images = {camera.name: scene.picture(camera)[0] for camera in rig.cameras}
    images["c0"][:6] = (200, 190, 180)  # a ceiling in one picture, so that the borders differ
    found = initial_points(rig, images, {}, stereo=False)
    assert "backdrop" in found.method
    assert len(found) > 100
    assert (scene.distance_to_box(found.positions) < 3 * PIXEL).mean() > 0.6


def test_frame_0_has_points_where_no_camera_confirms_any(scene):
    rig = scene.ring(4)
    rng = np.random.default_rng(0)
    images = {camera.name: rng.integers(0, 255, (128, 128, 3), dtype=np.uint8) for camera in rig.cameras}
    found = initial_points(rig, images, {}, stereo=False)
    assert found.method.endswith("volume + surroundings")
    assert found.coverage < ENOUGH_COVERAGE
    assert found.stage is not None
    on_stage = found.positions[found.stage.holds(found.positions)]
    inside = np.stack([pixels_inside(camera, on_stage)[3] for camera in rig.cameras])
    assert (inside.sum(axis=0) >= 2).all()
    assert len(on_stage) > 1000


def test_cameras_that_see_nothing_in_common_are_refused(scene):
    turned = np.diag([-1.0, 1, -1, 1])  # to look away from the others
    rig = Rig(
        tuple(
            Camera(camera.name, camera.intrinsics, turned @ camera.world_to_camera, camera.width, camera.height)
            for camera in scene.ring(2).cameras
        )
    )
    rng = np.random.default_rng(0)
    images = {name: rng.integers(0, 256, (128, 128, 3)).astype(np.uint8) for name in rig.names}
    with pytest.raises(InitialPointsError, match=r"^poses: no two cameras see the same place"):
        initial_points(rig, images, {}, stereo=False)
    images = {name: np.full((128, 128, 3), 9, np.uint8) for name in rig.names}
    with pytest.raises(InitialPointsError, match=r"^all 2 images are black .*; images: no place is in the foreground"):
        initial_points(rig, images, {}, stereo=False)


def test_empty_masks_are_named_and_not_the_calibration(scene):
    rig = scene.ring(3)
    images = {name: np.full((128, 128, 3), 9, np.uint8) for name in rig.names}
    masks = {name: np.zeros((128, 128), np.uint8) for name in rig.names}
    with pytest.raises(InitialPointsError) as caught:
        initial_points(rig, images, masks, stereo=False)
    said = str(caught.value)
    assert said.startswith("all 3 images are black (")
    assert "all masks are empty" in said
    assert "calibration" not in said


def test_points_that_one_way_labels_and_another_does_not_have_no_labels():
    lens = np.array([[64.0, 0, 32], [0, 64.0, 32], [0, 0, 1]])
    view = PosedPicture(Camera("front", lens, np.eye(4), 64, 64), np.zeros((64, 64, 3), np.uint8))
    near, far = (np.array([[x, 0.0, 1.0]]) for x in (0.0, 0.2))
    grey, label = np.full((1, 3), 0.5, np.float32), np.ones(1, np.float32)
    labelled, plain = InitialPoints(near, grey, label), InitialPoints(far, grey)
    for first, second, known in ((labelled, plain, False), (plain, labelled, False), (labelled, labelled, True)):
        found = merge_points(merge_points(None, first, "backdrop", [view], 0.1), second, "volume", [view], 0.1)
        assert found.method == "backdrop + volume"
        assert (found.foreground is not None) == known
        assert len(found.positions) == (1 if known else 2)  # the same place twice is one point


def test_cells_that_hold_points_are_covered():
    lens = np.array([[64.0, 0, 32], [0, 64.0, 32], [0, 0, 1]])
    view = PosedPicture(Camera("front", lens, np.eye(4), 64, 64), np.zeros((64, 64, 3), np.uint8))
    line = np.stack([np.linspace(-0.49, 0.49, 64), np.zeros(64), np.ones(64)], axis=1)
    cloud = InitialPoints(line, np.zeros((64, 3), np.float32))
    assert image_coverage([view], cloud) == pytest.approx(1 / 32)
    masked = PosedPicture(view.camera, view.image, np.zeros((64, 64), bool))
    masked.mask[32:34] = True
    assert image_coverage([masked], cloud) == pytest.approx(1.0)
