"""Lenses in plain NumPy, written from the models' definitions and not from OpenCV; rigs and pictures made with them."""

from __future__ import annotations

import numpy as np

from client.importers.lens import lens_camera

WIDTH, HEIGHT = 320, 240

LENSES = {
    "SIMPLE_PINHOLE": {"f": 210.0, "cx": 158.3, "cy": 121.9},
    "PINHOLE": {"fx": 210.0, "fy": 214.0, "cx": 158.3, "cy": 121.9},
    "SIMPLE_RADIAL": {"f": 210.0, "cx": 158.3, "cy": 121.9, "k1": -0.12},
    "RADIAL": {"f": 210.0, "cx": 158.3, "cy": 121.9, "k1": 0.09, "k2": -0.02},
    "OPENCV": {"fx": 210.0, "fy": 214.0, "cx": 158.3, "cy": 121.9, "k1": -0.21, "k2": 0.05, "p1": 2e-3, "p2": -3e-3},
    "OPENCV_FISHEYE": {
        "fx": 150.0, "fy": 151.0, "cx": 158.3, "cy": 121.9, "k1": 0.03, "k2": -0.01, "k3": 2e-3, "k4": -4e-4,
    },
    "FULL_OPENCV": {
        "fx": 210.0, "fy": 214.0, "cx": 158.3, "cy": 121.9, "k1": 0.4, "k2": -0.1, "p1": 1e-3, "p2": -2e-3,
        "k3": 0.02, "k4": 0.6, "k5": -0.08, "k6": 0.03,
    },
}  # fmt: skip


def distorted(model, parameters, rays):
    """Rays (x/z, y/z) [P, 2] to pixels [P, 2], the centre of the first pixel at (0.5, 0.5)."""
    p = {"k1": 0, "k2": 0, "k3": 0, "k4": 0, "k5": 0, "k6": 0, "p1": 0, "p2": 0} | parameters
    x, y = rays.T
    r2 = x * x + y * y
    if model == "OPENCV_FISHEYE":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        bent = theta * (1 + p["k1"] * theta**2 + p["k2"] * theta**4 + p["k3"] * theta**6 + p["k4"] * theta**8)
        x, y = x * bent / r, y * bent / r
    else:
        k = (1 + p["k1"] * r2 + p["k2"] * r2**2 + p["k3"] * r2**3) / (
            1 + p["k4"] * r2 + p["k5"] * r2**2 + p["k6"] * r2**3
        )
        x, y = (
            k * x + 2 * p["p1"] * x * y + p["p2"] * (r2 + 2 * x * x),
            k * y + p["p1"] * (r2 + 2 * y * y) + 2 * p["p2"] * x * y,
        )
    fx, fy = p.get("fx", p.get("f")), p.get("fy", p.get("f"))
    return np.stack([fx * x + p["cx"], fy * y + p["cy"]], axis=-1)


def pose(angle=0.3, back=3.0):
    """World to camera: turned about y, then moved back."""
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.eye(4)
    matrix[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    matrix[:3, 3] = [0.1, -0.05, back]
    return matrix


def camera(model, name="c0", world_to_camera=None, **changes):
    where = pose() if world_to_camera is None else world_to_camera
    return lens_camera(name, model, LENSES[model] | changes, where, (WIDTH, HEIGHT), source="made up")


def seen(lens, points):
    """World points [P, 3] to distorted pixels [P, 2]."""
    parameters = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), lens.distortion, strict=False))
    if lens.fisheye:
        parameters = dict(zip(("k1", "k2", "k3", "k4"), lens.distortion, strict=True))
    k = lens.intrinsics
    parameters |= {"fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
    x = points @ lens.world_to_camera[:3, :3].T + lens.world_to_camera[:3, 3]
    return distorted(lens.model, parameters, x[:, :2] / x[:, 2:])


def painted(pixels, sigma=1.3, size=(WIDTH, HEIGHT), ground=0, at=None):
    """A picture [H, W, 3] with a soft dot at each pixel position, sampled at `at` [H, W, 2], else at pixel centres."""
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5) if at is None else np.moveaxis(at, -1, 0)
    picture = np.zeros(u.shape)
    for x, y in pixels:
        picture = np.maximum(picture, np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * sigma**2)))
    return np.repeat(np.rint(ground + (255 - ground) * picture).astype(np.uint8)[..., None], 3, axis=-1)


def dot_at(picture, near, reach=7):
    """The centroid of the dot near a pixel position."""
    u, v = np.meshgrid(np.arange(picture.shape[1]) + 0.5, np.arange(picture.shape[0]) + 0.5)
    weight = picture[..., 0].astype(float) * ((u - near[0]) ** 2 + (v - near[1]) ** 2 < reach**2)
    assert weight.sum() > 0, f"no dot near {near}"
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
