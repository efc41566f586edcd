"""Projection, tile lists and blending in Warp, on its CPU device, against the reference in float64."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

import warp as wp
from engine_cases import apart
from warp_cases import BACKGROUND, DEVICE, LIMITS, Cloud, camera, cloud, drawn, index

from scas4d_core.engines.limits import Limits
from scas4d_core.engines.torch.rasterizer import CameraParams, project
from scas4d_core.engines.views import CameraArrays
from scas4d_core.engines.warp.layout import COLUMNS, PAIRS, TILE, Camera, camera_of
from scas4d_core.engines.warp.rasterizer import Rasterizer
from scas4d_core.guards import COVER_SLACK

CLOSE = 1e-4
SIZES = [(48, 32), (37, 29), (16, 16), (5, 3), (65, 17)]


class Drawn:
    """A cloud drawn by the kernels."""

    def __init__(self, given: Cloud, shot: CameraArrays, limits: Limits = LIMITS, capacity: int = 0) -> None:
        self.cameras = wp.array([camera_of(shot)], dtype=Camera, device=DEVICE)
        self.shot, self.first, self.arrays = shot, index(0), given.on_device()
        self.log = wp.zeros((1, COLUMNS), dtype=wp.float32, device=DEVICE)
        self.rasterizer = Rasterizer(DEVICE, len(given.means), limits)
        self.rasterizer.capacity = capacity or self.rasterizer.capacity
        self.rasterizer.resize(shot.width + 7, shot.height + 20)  # of a larger picture beside it
        self.draw()

    def draw(self) -> None:
        behind = wp.array([[*BACKGROUND, 0.0]], dtype=wp.vec4, device=DEVICE)
        self.rasterizer.project(self.cameras, self.first, *self.arrays, self.first, self.log)
        self.rasterizer.draw(self.cameras, self.first, self.arrays[3], behind)

    @property
    def room(self) -> float:
        return float(self.log.numpy()[0, PAIRS])

    @property
    def planes(self) -> np.ndarray:
        return self.rasterizer.planes.numpy()[:, : self.shot.height, : self.shot.width]

    @property
    def lists(self) -> list[list[int]]:
        starts, items = self.rasterizer.starts.numpy(), self.rasterizer.items.numpy()
        return [items[first:end].tolist() for first, end in pairwise(starts)]

    def gradients(self, g_planes: np.ndarray) -> list[np.ndarray]:
        """Of means, factors and features."""
        given = np.zeros(self.rasterizer.g_planes.shape, np.float32)
        given[:, : self.shot.height, : self.shot.width] = g_planes
        self.rasterizer.g_planes.assign(given)
        self.rasterizer.carry_back(self.cameras, self.first, self.arrays[3])
        out = [wp.zeros_like(self.arrays[k]) for k in (0, 1, 3)]
        self.rasterizer.carry_to_world(self.cameras, self.first, *self.arrays[:2], *out)
        return [array.numpy() for array in out]


def compared(given: Cloud, shot: CameraArrays, limits: Limits = LIMITS, tolerance: float = CLOSE) -> Drawn:
    """Draws a cloud, and compares values and gradients with the reference."""
    mine, tensors = Drawn(given, shot, limits), given.tensors()
    features, rest = drawn(tensors, shot, limits)
    assert apart(mine.planes[:4], features.permute(2, 0, 1).detach().numpy()) < tolerance
    assert apart(mine.planes[4], rest.detach().numpy()) < tolerance
    weights = np.random.default_rng(9).standard_normal((4, shot.height, shot.width))
    (features.permute(2, 0, 1) * torch.tensor(weights)).sum().backward()
    for found, tensor in zip(mine.gradients(weights), (tensors[0], tensors[1], tensors[3]), strict=True):
        assert np.linalg.norm(tensor.grad) > 0
        assert apart(found, tensor.grad.numpy()) < tolerance
    return mine


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_pictures_and_gradients_are_those_of_the_reference(width: int, height: int) -> None:
    compared(cloud(60), camera(width, height))


def test_lists_of_several_segments() -> None:
    mine = compared(cloud(700, radius=0.15), camera(24, 20))
    lengths = [len(entries) for entries in mine.lists]
    assert max(lengths) > 3 * 128
    assert mine.planes[4].min() < 0.001  # pixels that are finished
    assert mine.log.numpy()[0, PAIRS] == sum(lengths)


def test_lists_that_are_sorted_in_global_memory() -> None:
    given, shot = cloud(5000, radius=0.1, faint=0.01), camera(8, 8)
    mine = Drawn(given, shot)
    depths = given.means @ shot.pose[2, :3] + shot.pose[2, 3]
    (entries,) = (entries for entries in mine.lists if entries)
    assert len(entries) > 4500
    assert (np.diff(depths[entries]) > -1e-6).all()
    assert len(set(entries)) == len(entries)


def test_lists_of_segments_of_which_none_finishes_a_pixel() -> None:
    given = cloud(500, radius=0.15)
    mine = compared(given._replace(opacities=given.opacities * 0.02), camera(24, 20))
    assert mine.planes[4].min() > 0.005


@pytest.mark.parametrize("shape", ["needles", "points", "wide", "opaque"])
def test_gaussians_of_extreme_shapes(shape: str) -> None:
    given = cloud(200, seed=4)
    factors = {
        "needles": 5 * given.factors * np.float32([1, 1e-3, 1e-4]),
        "points": 1e-3 * given.factors,
        "wide": 10 * given.factors,
        "opaque": given.factors,
    }[shape]
    opacities = np.full(200, 0.9999, np.float32) if shape == "opaque" else given.opacities
    # The conic of a needle is a small difference of large numbers.
    tolerance = 1e-3 if shape == "needles" else CLOSE
    compared(given._replace(factors=factors, opacities=opacities), camera(41, 33), tolerance=tolerance)


def test_gaussians_beside_and_behind_the_camera() -> None:
    given = cloud(300, radius=1.5)
    mine = compared(given, camera(40, 24, distance=0.5))
    depths = given.means @ mine.shot.pose[2, :3] + mine.shot.pose[2, 3]
    assert (depths < LIMITS.near).sum() > 50
    assert (np.abs(given.means[:, 0]) > 1.3 * depths)[depths > LIMITS.near].sum() > 10  # beyond the tangents' bounds


@pytest.mark.parametrize(("count", "width", "height"), [(200, 61, 43), (40, 720, 400)])  # 12 tiles, and 1125
def test_lists_hold_exactly_the_supports_that_meet_a_tile_nearest_first(count: int, width: int, height: int) -> None:
    given, shot = cloud(count), camera(width, height)
    mine = Drawn(given, shot)
    tensors = [tensor.detach() for tensor in given.tensors()]
    splats = project(tensors[0], tensors[1], CameraParams.of_arrays(shot), LIMITS)
    inverses, means = torch.linalg.inv(splats.covariances).numpy(), splats.means.numpy()
    columns = -(-(shot.width + 7) // TILE)
    for tile, entries in enumerate(mine.lists):
        left, top = tile % columns * TILE, tile // columns * TILE
        right, bottom = min(left + TILE, shot.width), min(top + TILE, shot.height)
        if right <= left or bottom <= top:
            assert entries == []
            continue
        expected = []
        for row in np.argsort(splats.depths.numpy(), kind="stable").tolist():
            reach = 2 * np.log(given.opacities[row] / LIMITS.alpha_floor) * (1 + COVER_SLACK) + COVER_SLACK
            box = np.array([left, right - 1, top, bottom - 1]) + 0.5 - np.repeat(means[row], 2)
            if least_form(inverses[row], *box) <= reach:
                expected.append(row)
        assert entries == expected


def least_form(inverse: np.ndarray, left: float, right: float, top: float, bottom: float) -> float:
    """The least squared Mahalanobis distance from the origin to a rectangle: on its border, or 0."""
    if left <= 0 <= right and top <= 0 <= bottom:
        return 0.0
    (a, b), (_, c) = inverse
    ends = [(x, np.clip(-b * x / c, top, bottom)) for x in (left, right)]
    ends += [(np.clip(-b * y / a, left, right), y) for y in (top, bottom)]
    return min(a * x * x + 2 * b * x * y + c * y * y for x, y in ends)


def test_equal_depths_are_drawn_in_the_order_of_rows() -> None:
    given = cloud(150, radius=0.05)
    means = given.means.copy()
    means[1::2] = means[::2]
    mine = compared(given._replace(means=means), camera(16, 16))
    places = {row: place for place, row in enumerate(mine.lists[0])}
    pairs = [(row, row + 1) for row in range(0, 150, 2) if row in places and row + 1 in places]
    assert len(pairs) > 30
    assert all(places[second] == places[first] + 1 for first, second in pairs)


@pytest.mark.parametrize("hurt", ["means", "factors", "opacities", "features"])
def test_gaussians_that_are_not_sound_are_left_out(hurt: str) -> None:
    given, shot = cloud(40), camera(32, 32)
    arrays = {name: array.copy() for name, array in given._asdict().items()}
    for row, value in ((3, np.nan), (5, np.inf), (8, -1e16)):
        arrays[hurt][row] = value
    mine = compared(Cloud(**arrays), shot)
    for gradient in mine.gradients(np.ones((4, 32, 32))):
        assert not gradient[[3, 5, 8]].any()


def test_a_picture_of_nothing_is_the_background() -> None:
    given = cloud(5)
    mine = Drawn(given._replace(opacities=np.zeros(5, np.float32)), camera(20, 20))
    assert np.array_equal(mine.planes[:, 7, 9], np.float32([*BACKGROUND, 0, 1]))
    assert not any(np.any(gradient) for gradient in mine.gradients(np.ones((4, 20, 20))))


def test_lists_without_room_say_how_much_they_need_and_grow() -> None:
    given, shot = cloud(100), camera(48, 32)
    whole = Drawn(given, shot)
    entries = sum(map(len, whole.lists))
    assert whole.room == entries
    assert not whole.rasterizer.grow(whole.room)
    small = Drawn(given, shot, capacity=entries - 1)
    assert small.room == 1.25 * entries
    assert not any(small.lists)
    assert np.ptp(small.planes[4]) == 0  # drawn empty
    assert small.rasterizer.grow(small.room)
    small.draw()
    assert small.lists == whole.lists
    assert np.array_equal(small.planes, whole.planes)
    assert not small.rasterizer.grow(small.room)
    assert Drawn(given, shot, capacity=entries).lists == whole.lists


def test_drawing_twice_gives_the_same_bits() -> None:
    mine = Drawn(cloud(300), camera(40, 40))
    planes, lists = mine.planes.copy(), mine.lists
    mine.draw()
    assert np.array_equal(mine.planes, planes)
    assert mine.lists == lists
