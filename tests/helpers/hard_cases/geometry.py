"""Hard cases for Gaussians: unusual positions, sizes and opacities, and non-finite values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from hard_cases.case import CPU, BackendResult, HardCase
from hard_cases.rendering import Rendering
from scas4d_core.cameras import Camera
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.views import CameraArrays
from scas4d_core.kernels.blend import blend
from scas4d_core.kernels.projection import DEPTH, TILE

WIDTH, HEIGHT = 48, 40
COUNT = 40
"""Number of ordinary Gaussians among which the hard ones are placed."""


def camera(
    width: int = WIDTH, height: int = HEIGHT, focal: float = 50.0, centre: tuple[float, float] | None = None
) -> Camera:
    """Returns a camera at the origin that looks along z."""
    cx, cy = centre or (0.47 * width, 0.53 * height)
    return Camera("c", np.array([[focal, 0, cx], [0, 1.1 * focal, cy], [0, 0, 1]]), np.eye(4), width, height)


def ordinary(count: int = COUNT, seed: int = 0, scale: float = 1.0, before: Camera | None = None) -> Rendering:
    """Creates Gaussians of 1 to 6 pixels, 2 to 3 m in front of the camera. ``scale`` multiplies all lengths."""
    rng = np.random.default_rng(seed)
    seen = before or camera()
    pixels = rng.uniform(0, (seen.width, seen.height), (count, 2))
    depth = rng.uniform(2, 3, count)
    means = seen.unproject(pixels, depth)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0] if count else np.zeros((0, 3, 3))
    widths = rng.uniform(1, 6, (count, 1, 3)) * (depth / seen.fx)[:, None, None]
    return Rendering(
        (scale * means).astype(np.float32),
        (scale * axes * widths).astype(np.float32),
        rng.uniform(0.1, 0.9, count).astype(np.float32),
        rng.uniform(0, 1, (count, 4)).astype(np.float32),
        seen,
        bad=np.zeros(count, bool),
    )


def among(
    hard: int, means: Any = None, factors: Any = None, opacities: Any = None, features: Any = None, bad: bool = False,
    count: int = COUNT, before: Camera | None = None, **changes: Any,
) -> Rendering:  # fmt: skip
    """Creates ``count`` ordinary Gaussians, with ``hard`` hard ones inserted at random rows.

    The given arrays are broadcast over the hard Gaussians. ``bad`` is True if the hard ones must be excluded from the
    image. ``changes`` are other fields of the case.
    """
    base = ordinary(count + hard, before=before)
    rows = np.random.default_rng(1).permutation(count + hard)[:hard]
    arrays: dict[str, Any] = {}
    given = {"means": means, "factors": factors, "opacities": opacities, "features": features}
    for name, values in given.items():
        array = getattr(base, name).copy()
        if values is not None:
            array[rows] = values
        arrays[name] = array
    marked = np.zeros(count + hard, bool)
    marked[rows] = bad
    return replace(base, **arrays, bad=marked, **changes)


def left_out(hard: int, guard: str = "not_finite", **given: Any) -> Rendering:
    """Creates hard Gaussians that must be excluded from the image and counted by ``guard``."""
    return among(hard, bad=True, guards={guard: hard}, **given)


BALL = 0.1 * np.eye(3)


def _culled_as_behind(count: int) -> Rendering:
    return among(count, means=(0, 0, 0), bad=True)


def _near_plane(near: float) -> Rendering:
    """Places Gaussians just before, on and just behind the near plane, with a width of 2% of its depth."""
    z = np.float32(near)
    depths = np.array([np.nextafter(z, np.float32(0)), z, np.nextafter(z, np.float32(9))])
    limits = Rendering.limits._replace(near=float(z))
    means = np.zeros((3, 3))
    means[:, 2] = depths
    made = among(3, means=means, factors=0.02 * near * np.eye(3), limits=limits, bound=1e9)
    made.bad[np.flatnonzero(made.means[:, 2] == depths[0])] = True
    return made


def _off_axis(degrees: float) -> Rendering:
    angle = np.radians(degrees)
    around = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    means = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle) + 0 * around], -1)
    return among(8, means=2 * means, factors=0.3 * np.eye(3), value=1e-3, gradient=1e-2)


def _needle(length: float) -> Rendering:
    rng = np.random.default_rng(2)
    axes = np.linalg.qr(rng.normal(size=(12, 3, 3)))[0]
    return among(12, factors=axes * np.array([length, length / 1000, length / 1000]), value=1e-3, gradient=1e-2)


def _along_the_ray(length: float) -> Rendering:
    """Creates needles that point at the camera. The longest ones extend behind it."""
    return among(6, means=(0, 0, 2.5), factors=np.diag([1e-3, 1e-3, length]), value=1e-3, gradient=1e-2)


def _pancake(tilt: float) -> Rendering:
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return among(6, factors=turn * np.array([0.2, 0.2, 2e-4]), value=1e-3, gradient=1e-2)


def _at_one_pixel(count: int) -> Rendering:
    rng = np.random.default_rng(3)
    depths = rng.uniform(1, 4, count)
    means = np.stack([0.02 * depths, 0.01 * depths, depths], -1)
    # Thousands of factors 1 − alpha are multiplied, so float32 rounding errors accumulate.
    return among(count, means=means, factors=0.01 * np.eye(3), opacities=0.02, value=2e-3, gradient=2e-2, bound=1e8)


def _opaque(problem: Rendering, outcomes: Mapping[str, BackendResult]) -> list[str]:
    """Checks that alpha is large at the centre of every opaque Gaussian, despite the alpha cap."""
    rows = np.flatnonzero(problem.opacities >= 0.98)
    places, _ = problem.camera.project(problem.means[rows])
    columns, lines = np.floor(places).astype(int).T
    inside = (columns >= 0) & (columns < problem.camera.width) & (lines >= 0) & (lines < problem.camera.height)
    faults = []
    for backend, outcome in outcomes.items():
        least = outcome.values["alpha"][lines[inside], columns[inside]].min()
        if least < 0.75:
            faults.append(f"{backend}: alpha is {least:.2g} in the middle of an opaque Gaussian")
    return faults


def _on_a_pixel(seed: int) -> Culled:
    """Creates Gaussians whose support ends, up to rounding, at the only pixel that it covers in a block."""
    rng = np.random.default_rng(seed)
    count, depth, focal, low_pass = 2000, 2.0, 64.0, float(np.float32(Rendering.limits.low_pass))
    reach = rng.integers(2, 20, count)
    column, row = rng.integers(20, 236, count), 4 * rng.integers(8, 56, count) + 3 + reach
    wished = np.square(reach) / (2 * np.log(255 * rng.uniform(0.05, 0.9, count)))
    width = np.sqrt(np.maximum(wished - 0.3, 1e-3))
    variance = np.square(width) + low_pass
    opacity = np.exp(np.square(reach) / (2 * variance)) / 255 * (1 + 6e-8 * rng.integers(-6, 7, count))
    kept = opacity < 0.95
    means = np.stack([(column + 0.5) * depth / focal, (row + 0.5) * depth / focal, np.full(count, depth)], -1)
    return Culled(
        means[kept].astype(np.float32),
        (width[kept, None, None] * depth / focal * np.eye(3)).astype(np.float32),
        opacity[kept].astype(np.float32),
        np.ones((int(kept.sum()), 4), np.float32),
        Camera("c", np.array([[focal, 0, 0], [0, focal, 0], [0, 0, 1]]), np.eye(4), 256, 256),
        bad=np.zeros(int(kept.sum()), bool),
    )


ARRAYS = ("means", "factors", "opacities", "features")
TOGETHER = 100
"""Number of Gaussians rendered together. With more, pixels would saturate before all Gaussians contribute."""


def _culling_is_exact(problem: Rendering) -> list[str]:
    """Checks that the image is bit-identical to one rendered with every Gaussian in every block of every tile."""
    changed = 0
    for first in range(0, len(problem.means), TOGETHER):
        rows = slice(first, first + TOGETHER)
        means, factors, opacities, features = (np.ascontiguousarray(getattr(problem, name)[rows]) for name in ARRAYS)
        rasterizer = CpuRasterizer(problem.limits)
        view, black = CameraArrays.of(problem.camera), np.zeros(4, np.float32)
        picture = rasterizer.forward(means, factors, opacities, features, view, black).features.copy()
        splats = rasterizer.splats
        order = np.argsort(splats[:, DEPTH], kind="stable").astype(np.int32)
        tiles = -(-view.width // TILE) * -(-view.height // TILE)
        image, transmittance = np.empty_like(rasterizer.planes), np.empty(rasterizer.planes.shape[1:], np.float32)
        blend(
            splats, features, (0,), np.arange(tiles + 1) * len(order), np.tile(order, tiles),
            np.full(tiles * len(order), 2**64 - 1, np.uint64), np.full(tiles, 2**64 - 1, np.uint64),
            np.arange(tiles), np.array([0, tiles]), (view.width, view.height), black, rasterizer.limits, image,
            transmittance,
        )  # fmt: skip
        changed += int((image[:, : view.height, : view.width] != picture).any(axis=0).sum())
    return [f"culling changes {changed} pixels"] if changed else []


class Culled(Rendering):
    """Problem that checks only culling, on the CPU."""

    def run(self, backend: str) -> BackendResult | None:
        """Renders the Gaussians on the CPU, or returns None for other backends."""
        return self._cpu() if backend == CPU else None

    def violations(self, outcomes: Mapping[str, BackendResult]) -> list[str]:
        """Returns a line if culling changes any pixel."""
        return _culling_is_exact(self)


def _equal_depths(count: int) -> Rendering:
    rng = np.random.default_rng(4)
    means = np.concatenate([rng.uniform(-0.3, 0.3, (count, 2)), np.full((count, 1), 2.0)], -1)
    return among(count, means=means, factors=BALL)


def _by_row(problem: Rendering, outcomes: Mapping[str, BackendResult]) -> list[str]:
    """Checks that ties are broken by row order: swapping tied rows changes the image, but rendering again does not."""
    again = problem.run(CPU)
    assert again is not None
    same = np.array_equal(again.values["features"], outcomes[CPU].values["features"])
    tied = np.flatnonzero(problem.means[:, 2] == 2.0)
    order = np.arange(len(problem.means))
    order[tied] = tied[::-1]
    turned = replace(problem, **{name: getattr(problem, name)[order] for name in ("means", "features", "opacities")})
    swapped = turned.run(CPU)
    assert swapped is not None
    differs = not np.array_equal(swapped.values["features"], outcomes[CPU].values["features"])
    return ([] if same else ["identical renders differ"]) + ([] if differs else ["ties do not follow the row order"])


def _mirrored(count: int) -> Rendering:
    return among(count, factors=BALL * np.array([1, 1, -1.0]))


def _as_unmirrored(problem: Rendering, outcomes: Mapping[str, BackendResult]) -> list[str]:
    plain = replace(problem, factors=np.abs(problem.factors) * (problem.factors != 0))
    rows = np.linalg.det(problem.factors) < 0
    factors = problem.factors.copy()
    factors[rows] = np.abs(factors[rows])
    other = replace(plain, factors=factors).run(CPU)
    assert other is not None
    off = np.abs(other.values["features"] - outcomes[CPU].values["features"]).max()
    return [] if off < 1e-6 else [f"a mirrored factor changes the image by {off:.2g}"]


def _nothing_seen(problem: Rendering, outcomes: Mapping[str, BackendResult]) -> list[str]:
    return [
        f"{backend}: alpha up to {outcome.values['alpha'].max():.2g} where nothing is drawn"
        for backend, outcome in outcomes.items()
        if outcome.values["alpha"].size and np.abs(outcome.values["alpha"]).max() > 1e-6
    ]


def _far_and_near(far: float) -> Rendering:
    means = np.concatenate([np.repeat([[0, 0, far]], 4, 0), np.repeat([[0, 0, 0.03]], 4, 0)])
    factors = np.concatenate([np.repeat([0.05 * far * np.eye(3)], 4, 0), np.repeat([1e-3 * np.eye(3)], 4, 0)])
    return among(8, means=means, factors=factors, opacities=0.4, bound=1e8)


def _few(count: int) -> Rendering:
    """Creates Gaussians whose last group of sixteen may be incomplete and ends with an invalid Gaussian."""
    made = ordinary(count)
    made.means[-1] = np.nan
    made.bad[-1] = True
    return replace(made, guards={"not_finite": 1})


def _steep(weight: float) -> Rendering:
    """Uses pixel weights so large that gradients overflow in float32, but not in float64."""
    return replace(
        ordinary(), weight=weight, bound=1e38, value=2e-4, gradient=None, guards=None, why="beyond the range of float32"
    )


def _counted_steep(problem: Rendering, outcomes: Mapping[str, BackendResult]) -> list[str]:
    acted = outcomes[CPU].guards["gradient_not_finite"]
    if problem.weight >= 1e35 and acted == 0:
        return ["no gradient was dropped, although the weights are at the limit of float32"]
    return [] if problem.weight >= 1e20 or acted == 0 else [f"{acted} gradients within range were dropped"]


def _small_picture(size: tuple[int, int]) -> Rendering:
    width, height = size
    return ordinary(before=camera(width, height, 50.0))


def _principal_point(offset: float) -> Rendering:
    """Places the principal point outside the image, ``offset`` image widths from the left edge."""
    before = camera(centre=(offset * WIDTH, 0.5 * HEIGHT))
    return replace(ordinary(before=before), value=1e-3, gradient=1e-2, bound=1e8)


def _focal(pixels: float) -> Rendering:
    return replace(ordinary(before=camera(focal=pixels)), value=2e-3, gradient=2e-2, bound=1e3 * max(pixels, 1e4))


def _scaled(scale: float) -> Rendering:
    """Scales the scene and the near plane. Gradients with respect to lengths scale inversely."""
    made = ordinary(scale=scale)
    return replace(made, limits=made.limits._replace(near=0.01 * scale), bound=1e7 / min(scale, 1.0))


def _as_unscaled(problem: Rendering, outcomes: Mapping[str, BackendResult]) -> list[str]:
    plain = ordinary().run(CPU)
    assert plain is not None
    off = np.abs(plain.values["features"] - outcomes[CPU].values["features"])
    share = float(np.mean(off.max(axis=0) > 1e-4))
    return [] if share <= 0.005 else [f"{100 * share:.2g}% of the pixels change with the scale"]


CASES = (
    HardCase(
        "camera centre",
        "number of Gaussians at the camera centre, which are not drawn",
        "graphdeco-inria/gaussian-splatting#41",
        (1, 16, 200),
        _culled_as_behind,
    ),
    HardCase(
        "near plane",
        "distance of the near plane in metres; one Gaussian in front of it, one on it, one behind it",
        "JonathonLuiten/Dynamic3DGaussians#3, playcanvas/engine#7186",
        (0.01, 0.3, 2.0),
        _near_plane,
    ),
    HardCase(
        "behind",
        "distance behind the camera in metres; the Gaussians are not drawn",
        "3D Gaussian Splatting, culling",
        (1e-6, 1e-3, 1.0, 1e6),
        lambda d: among(5, means=(0.1, 0, -d), bad=True),
    ),
    HardCase(
        "off-axis",
        "angle from the axis in degrees; eight Gaussians of 0.3 m at a distance of 2 m",
        "gsplat#977, aras-p/UnityGaussianSplatting#196",
        (60.0, 80.0, 89.0, 89.9),
        _off_axis,
    ),
    HardCase("needle", "length in metres, with an aspect ratio of 1:1000", "gsplat#613", (0.01, 0.1, 1.0), _needle),
    HardCase(
        "needle along the ray",
        "length in metres; 1 mm thick, and the longest extend behind the camera",
        "JonathonLuiten/Dynamic3DGaussians#3",
        (0.1, 3.0, 100.0),
        _along_the_ray,
    ),
    HardCase(
        "pancake",
        "tilt in degrees, from face-on to edge-on; aspect ratio 1:1000",
        "2D Gaussian Splatting",
        (0.0, 45.0, 89.0, 90.0),
        _pancake,
    ),
    HardCase(
        "smaller than a pixel",
        "length of the axes in metres",
        "playcanvas/engine#8437",
        (1e-3, 1e-5, 1e-8),
        lambda s: among(12, factors=s * np.eye(3)),
    ),
    HardCase(
        "larger than the image",
        "length of the axes in metres",
        "playcanvas/engine#7696, gsplat#613",
        (2.0, 20.0, 200.0),
        lambda s: among(4, factors=s * np.eye(3), value=1e-3, gradient=1e-2),
    ),
    HardCase(
        "equal depth",
        "number of Gaussians at exactly the same depth; drawn in row order, and bit-identical when repeated",
        "gsplat#99, NVlabs/nvdiffrast#168",
        (2, 17, 300),
        _equal_depths,
        _by_row,
    ),
    HardCase(
        "stacked on a pixel",
        "number of Gaussians over one pixel",
        "r4dl/StopThePop#5",
        (100, 1000, 5000),
        _at_one_pixel,
    ),
    HardCase(
        "fainter than the floor",
        "opacity in units of 1/255; not drawn, and no logarithm below 0 is used",
        "fastgs/FastGS#58",
        (0.0, 0.5, 0.999),
        lambda o: among(9, opacities=o / 255, bad=True),
    ),
    HardCase(
        "opacity at the floor",
        "opacity as an exact multiple of 1/255",
        "fastgs/FastGS#58",
        (1.0, 1.001),
        lambda o: among(9, opacities=np.float32(1 / 255) * np.float32(o)),
    ),
    HardCase(
        "support that ends on a pixel",
        "random seed of 2000 Gaussians; culling by blocks and tiles changes no bit",
        "exact culling",
        (37, 56, 65),
        _on_a_pixel,
    ),
    HardCase(
        "opacity at one",
        "opacity; no gradient passes through the cap; two capped ones reach exactly the stop, and either result is "
        "correct",
        "gsplat, alpha cap",
        (0.98, 0.99, 1.0, 2.0),
        lambda o: among(9, opacities=o, value=1.1e-2),
        _opaque,
    ),
    HardCase(
        "zero-length axes",
        "number of Gaussians with a zero factor, which are drawn as dots of one pixel",
        "gsplat 3DGUT, zero scales",
        (1, 17),
        lambda n: among(n, factors=0),
    ),
    HardCase(
        "axes of 1e-12",
        "multiple of 1e-12 m",
        "edge of float32",
        (1.0, 1e-20),
        lambda s: among(9, factors=1e-12 * s * np.eye(3)),
    ),
    HardCase(
        "axes of 1 km",
        "multiple of 1 km; a haze over the whole image",
        "gsplat#613, inuex35/360-gaussian-splatting#18",
        (1.0, 10.0),
        lambda s: among(4, factors=1e3 * s * np.eye(3), value=5e-3, gradient=2e-2),
    ),
    HardCase(
        "footprint beyond float32",
        "length of the axes in metres; the Gaussians are skipped and counted",
        "graphdeco-inria/gaussian-splatting#781",
        (1e8, 1e12, 1e14),
        lambda s: left_out(
            4, "footprint_ceiling", factors=s * np.eye(3), value=None, gradient=None, why="float64 still draws them"
        ),
    ),
    HardCase(
        "infinite axes",
        "number of Gaussians, which are skipped and counted",
        "graphdeco-inria/gaussian-splatting#781",
        (1, 16),
        lambda n: left_out(n, factors=np.inf),
    ),
    HardCase(
        "NaN axes",
        "index of the NaN entry of the factor",
        "inuex35/360-gaussian-splatting#18",
        (0, 4, 8),
        lambda k: left_out(3, factors=np.where(np.arange(9).reshape(3, 3) == k, np.nan, BALL)),
    ),
    HardCase(
        "NaN mean",
        "index of the NaN coordinate",
        "gsplat#248, vye16/shape-of-motion#43",
        (0, 1, 2),
        lambda k: left_out(3, means=np.where(np.arange(3) == k, np.nan, [0, 0, 2.0])),
    ),
    HardCase(
        "infinite mean",
        "index of the infinite coordinate",
        "gsplat#248",
        (0, 1, 2),
        lambda k: left_out(3, means=np.where(np.arange(3) == k, -np.inf, [0, 0, 2.0])),
    ),
    HardCase(
        "NaN opacity", "number of Gaussians", "openvdb/fvdb-core#410", (1, 17), lambda n: left_out(n, opacities=np.nan)
    ),
    HardCase(
        "NaN colour",
        "index of the NaN channel, which would spoil every pixel that the Gaussian covers",
        "openvdb/fvdb-core#410",
        (0, 1, 3),
        lambda k: left_out(3, features=np.where(np.arange(4) == k, np.nan, 0.5)),
    ),
    HardCase(
        "infinite colour",
        "value of the colour",
        "the fourth powers in SSIM",
        (1e10, 1e38, np.inf),
        lambda v: left_out(3, features=v),
    ),
    HardCase(
        "only NaN",
        "number of Gaussians, none of which is finite; only the background is drawn",
        "gsplat#248",
        (1, 40),
        lambda n: left_out(n, count=0, means=np.nan),
        _nothing_seen,
    ),
    HardCase("no Gaussians", "number of Gaussians", "edge of the arrays", (0,), lambda n: ordinary(n), _nothing_seen),
    HardCase(
        "incomplete last group",
        "number of Gaussians, the last of which is NaN",
        "sixteen at a time",
        (1, 2, 15, 16, 17, 33),
        _few,
    ),
    HardCase(
        "mirrored factor",
        "number of Gaussians with det F < 0; Σ and the image are unchanged",
        "reflections",
        (1, 9),
        _mirrored,
        _as_unmirrored,
    ),
    HardCase(
        "far and near at once",
        "depth in metres of four Gaussians, with four more at 3 cm; the order is kept",
        "playcanvas/supersplat#396",
        (1e3, 1e6, 1e9),
        _far_and_near,
    ),
    HardCase(
        "gradients beyond float32",
        "pixel weights; overflowing gradients are dropped per Gaussian and counted",
        "gsplat#248",
        (1e15, 1e28, 1e36),
        _steep,
        _counted_steep,
    ),
    HardCase("tiny images", "width and height", "edge of the tiles", ((1, 1), (1, 40), (33, 32)), _small_picture),
    HardCase(
        "principal point outside",
        "position in image widths from the left edge",
        "cropped rigs",
        (-1.0, 2.0, 10.0),
        _principal_point,
    ),
    HardCase(
        "focal length",
        "focal length in pixels for an image 48 pixels wide, from fisheye to telescope",
        "rigs of mixed lenses",
        (5.0, 500.0, 50_000.0),
        _focal,
    ),
    HardCase(
        "scene and near plane scaled",
        "scale factor; the image stays the same",
        "users' units",
        (1e-3, 1e-2, 1e2, 1e3),
        _scaled,
        _as_unscaled,
    ),
)
