"""The mathematics of alignment: flow and slopes are derivatives, and what a camera was turned by is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from scas4d_core.cameras import Camera
from scas4d_core.effects.cameras.alignment import (
    adjoint,
    align_pixels,
    equations,
    flow,
    pixel_offset,
    solve_twist,
    turn_equations,
    turn_from_pixels,
    twist_equations,
    twist_to_matrix,
)

LENS = np.array([210.0, 190.0, 60.0, 50.0, 120.0, 96.0], np.float32)
CAMERA = Camera("one", np.array([[210, 0, 60], [0, 190, 50], [0, 0, 1.0]]), np.eye(4), 120, 96)
RNG = np.random.default_rng(3)
WAVES = RNG.uniform(-14, 14, (3, 6, 2))
PHASES = RNG.uniform(0, 6, (3, 6))


def seen_by(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[3, H, W] float64 of a wavy picture on a slanted wall, and [H, W] its depth along z, without any rounding."""
    camera = replace(CAMERA, world_to_camera=pose)
    u, v = np.meshgrid(np.arange(120) + 0.5, np.arange(96) + 0.5)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays, normal = rays @ camera.rotation, np.array([0.5, -0.3, 1.0])
    depth = (3.0 - camera.centre @ normal) / (rays @ normal)
    points = camera.centre + depth[..., None] * rays
    angles = np.einsum("hwd,cnd->cnhw", points[..., :2], WAVES)
    return 0.5 + 0.06 * np.sin(angles + PHASES[:, :, None, None]).sum(axis=1), depth


def test_the_flow_is_the_derivative_of_the_projection() -> None:
    uv = RNG.uniform([0, 0], [120, 96], (40, 2))
    depth = RNG.uniform(1, 5, 40)
    points = CAMERA.unproject(uv, depth)
    told = flow(LENS, uv.T, depth)
    for number in range(6):
        way = np.zeros(6)
        way[number] = 1e-6
        ahead, back = (
            replace(CAMERA, world_to_camera=twist_to_matrix(sign * way)).project(points)[0] for sign in (1, -1)
        )
        np.testing.assert_allclose(told[:, number], (ahead - back).T / 2e-6, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("number", range(6))
def test_minus_slope_times_flow_is_the_derivative_of_the_picture(number: int) -> None:
    """A residual that is the true derivative of one number is explained by that number, and by no other."""
    shown, depth = seen_by(np.eye(4))
    way = np.zeros(6)
    way[number] = 1e-5
    change = (seen_by(twist_to_matrix(way))[0] - seen_by(twist_to_matrix(-way))[0]) / 2e-5
    told = align_pixels(shown.astype(np.float32), shown.astype(np.float32))
    assert told is not None
    one = told._replace(target=change.reshape(3, -1)[:, told.pixels] * 1e-4, shown=np.zeros_like(told.shown))
    moved = flow(LENS, told.places, depth.reshape(-1)[told.pixels])
    found = np.linalg.solve(*equations(one, moved)[:2]) / 1e-4
    scale = np.array([70.0] * 3 + [200.0] * 3)  # a metre, and a radian, in pixels
    np.testing.assert_allclose(found * scale, way / 1e-5 * scale, atol=0.03 * scale[number])


def test_a_twist_is_found() -> None:
    twist = np.array([0.008, -0.005, 0.01, 0.004, -0.006, 0.01])
    target, _ = seen_by(twist_to_matrix(twist))
    found = np.zeros(6)
    for _ in range(6):
        shown, depth = seen_by(twist_to_matrix(found))
        told = align_pixels(target.astype(np.float32), shown.astype(np.float32))
        assert told is not None
        found = found + solve_twist(twist_equations(LENS, told, depth.astype(np.float32)), LENS, found)
    corners = flow(LENS, np.array([[10, 60, 110.0], [80, 50, 5.0]]), 3.0)
    off = np.einsum("dkp,k->dp", corners, found - twist)
    assert np.abs(np.einsum("dkp,k->dp", corners, twist)).max() > 1  # pixels
    assert np.abs(off).max() < 0.25  # shifts are thought to be small


@pytest.mark.parametrize("every", [1, 2])
def test_a_turn_is_found_from_a_thinned_rendering_and_without_depth(every: int) -> None:
    pixels = np.array([0.4, -0.3, 0.25])
    twist = np.concatenate([np.zeros(3), turn_from_pixels(LENS) @ pixels])
    np.testing.assert_allclose(pixel_offset(LENS, twist, 3.0), pixels, atol=0.02)
    target, shown = (seen_by(twist_to_matrix(way))[0].astype(np.float32) for way in (twist, np.zeros(6)))
    told = align_pixels(target, shown[:, ::every, ::every], every)
    assert told is not None
    one = turn_equations(LENS, told)
    np.testing.assert_allclose(np.linalg.solve(one.matrix, one.vector), pixels, atol=0.04)
    moved = np.einsum("dkp,kl->dlp", flow(LENS, told.places)[:, 3:], turn_from_pixels(LENS))
    np.testing.assert_allclose(one.matrix, equations(told, moved).matrix, rtol=1e-9)


def test_a_bare_wall_tells_nothing() -> None:
    wall = np.full((3, 40, 40), 0.5, np.float32)
    assert align_pixels(wall, wall) is None


def test_a_thing_in_the_way_weighs_little() -> None:
    target, shown = (
        seen_by(twist_to_matrix(np.array([0, 0, 0, 0, way, 0])))[0].astype(np.float32) for way in (0.002, 0)
    )
    target[:, 30:50, 40:70] = 1.0
    told = align_pixels(target, shown)
    assert told is not None
    one = turn_equations(LENS, told)
    np.testing.assert_allclose(np.linalg.solve(one.matrix, one.vector), [0.42, 0, 0], atol=0.06)


@pytest.mark.parametrize("size", [1e-9, 0.99e-4, 1.01e-4, 0.02, 1.5])
def test_the_exponential_is_that_of_the_matrix(size: float) -> None:
    twist = np.array([0.3, -0.2, 0.5, *size * np.array([0.6, -0.64, 0.48])])
    generator = np.zeros((4, 4))
    x, y, z = twist[3:]
    generator[:3, :3], generator[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], twist[:3]
    np.testing.assert_allclose(twist_to_matrix(twist), expm(generator), atol=1e-12)


def test_the_adjoint_carries_a_twist_through_a_pose() -> None:
    pose, twist = twist_to_matrix(RNG.normal(size=6)), RNG.normal(size=6)
    np.testing.assert_allclose(twist_to_matrix(adjoint(pose) @ twist) @ pose, pose @ twist_to_matrix(twist), atol=1e-12)
