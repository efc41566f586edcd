"""The CPU rasterizer against its float64 twin, which culls nothing but what is behind the near plane."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numba
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from scas4d_core.cameras import Camera
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer, Drawing
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.torch import rasterizer as twin
from scas4d_core.engines.views import CameraArrays
from scas4d_core.kernels import box_loss

SIZES = [(5, 3), (16, 16), (37, 29), (64, 48), (100, 33)]


class Scene(NamedTuple):
    """What a rasterizer is given, float32."""

    means: np.ndarray
    factors: np.ndarray
    opacities: np.ndarray
    features: np.ndarray
    background: np.ndarray


def make_camera(width: int, height: int, seed: int = 0) -> Camera:
    """Looks from about 2 m at the origin, rolled, its principal point off the middle."""
    rotation = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.6, 3)).as_matrix()
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[2, 3] = 2.0
    focal = 0.9 * max(width, height)
    lens = [[focal, 0, 0.47 * width + 0.3], [0, 1.1 * focal, 0.56 * height - 0.2], [0, 0, 1]]
    return Camera("c", np.array(lens), pose, width, height)


def make_scene(count: int, channels: int, camera: Camera, seed: int = 0) -> Scene:
    """Ordinary Gaussians and every odd kind: off the picture, behind, huge, below a pixel, needles, faint, capped."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, 0.45, (count, 3))
    lengths = rng.uniform(0.01, 0.12, (count, 3))
    opacities = rng.uniform(0.05, 0.9, count)
    kinds = np.array_split(rng.permutation(count)[: count // 2], 7)
    seen = camera.to_camera(means)
    seen[kinds[0], 0] += rng.choice([-1, 1], len(kinds[0])) * rng.uniform(1, 4, len(kinds[0]))  # off the picture
    seen[kinds[1], 2] -= rng.uniform(1.9, 4, len(kinds[1]))  # behind, or nearly
    lengths[kinds[2]] *= 10
    lengths[kinds[3]] *= 1e-3
    lengths[kinds[4]] = [0.4, 0.002, 0.002]
    opacities[kinds[5]] = rng.uniform(0, 1.2 / 255, len(kinds[5]))
    opacities[kinds[6]] = rng.uniform(0.991, 1, len(kinds[6]))
    means = (seen - camera.translation) @ camera.rotation
    axes = Rotation.random(count, random_state=seed).as_matrix()
    return Scene(
        means.astype(np.float32),
        (axes * lengths[:, None, :]).astype(np.float32),
        opacities.astype(np.float32),
        rng.uniform(0, 1, (count, channels)).astype(np.float32),
        rng.uniform(0, 1, channels).astype(np.float32),
    )


class Truth(NamedTuple):
    """The twin's picture, its leaves, and which pixels are far from every discontinuity."""

    features: torch.Tensor
    alpha: torch.Tensor
    leaves: list[torch.Tensor]
    smooth: np.ndarray


def twin_of(scene: Scene, camera: Camera, limits: Limits = DEFAULT, depth_channel: int = -1) -> Truth:
    leaves = [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in scene[:4]]
    means, factors, opacities, features = leaves
    params = twin.CameraParams.of(camera)
    if depth_channel >= 0:
        depth = params.depths(means)[:, None]
        features = torch.cat([features[:, :depth_channel], depth, features[:, depth_channel + 1 :]], dim=1)
    background = torch.tensor(scene.background, dtype=torch.float64)
    picture = twin.render(means, factors, opacities, features, params, background, limits)
    return Truth(picture.features, picture.alpha, leaves, smooth_pixels(scene, params, limits))


def smooth_pixels(scene: Scene, camera: twin.CameraParams, limits: Limits) -> np.ndarray:
    """[H, W] where no alpha is at the floor or the cap, and no transmittance at the stop, within float32's error."""
    projected = twin.project(*(torch.tensor(a, dtype=torch.float64) for a in scene[:2]), camera, limits)
    depths = projected.depths.numpy()
    order = np.argsort(depths, kind="stable")
    order = order[depths[order] >= limits.near]
    conics = np.linalg.inv(projected.covariances.numpy()[order])
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    d = np.stack([u, v], axis=-1)[:, :, None] - projected.means.numpy()[order]
    form = np.einsum("hwni,nij,hwnj->hwn", d, conics, d)
    free = scene.opacities[order] * np.exp(-0.5 * form)
    alpha = np.minimum(free, limits.alpha_cap)
    alpha[alpha < limits.alpha_floor] = 0
    left = np.cumprod(1 - alpha, axis=-1)
    near_floor = np.abs(free - limits.alpha_floor) < 2e-3 * limits.alpha_floor
    near_cap = np.abs(free - limits.alpha_cap) < 1e-4
    near_stop = (np.abs(left - limits.transmittance_stop) < 2e-2 * limits.transmittance_stop) & (alpha > 0)
    result: np.ndarray = ~(near_floor | near_cap | near_stop).any(axis=-1)
    return result


def render(
    scene: Scene, camera: Camera, limits: Limits = DEFAULT, depth_channel: int = -1
) -> tuple[CpuRasterizer, np.ndarray, np.ndarray]:
    """The rasterizer, features [H, W, C] and alpha [H, W]."""
    rasterizer = CpuRasterizer(limits)
    features = scene.features.copy()
    picture = rasterizer.forward(
        *scene[:3], features, CameraArrays.of(camera), scene.background, depth_channel=depth_channel
    )
    return rasterizer, np.moveaxis(picture.features, 0, -1).copy(), 1 - picture.transmittance


def pull(rasterizer: CpuRasterizer, g_image: np.ndarray, g_alpha: np.ndarray) -> list[np.ndarray]:
    """Copies of dL/d(means, factors, opacities, features, screen) for dL/dpicture [H, W, C] and dL/dalpha [H, W]."""
    planes, alpha = rasterizer.gradient_buffers()
    height, width = g_alpha.shape
    planes[:, :height, :width] = np.moveaxis(g_image, -1, 0)
    alpha[:height, :width] = g_alpha
    return [array.copy() for array in rasterizer.backward(planes, alpha)]


def assert_agrees(scene: Scene, camera: Camera, limits: Limits = DEFAULT, depth_channel: int = -1) -> None:
    """Picture and all gradients agree with the twin on smooth pixels, which are most."""
    truth = twin_of(scene, camera, limits, depth_channel)
    rasterizer, features, alpha = render(scene, camera, limits, depth_channel)
    smooth = truth.smooth
    assert smooth.mean() > 0.5
    expected = truth.features.detach().numpy()
    scale = max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(features[smooth], expected[smooth], atol=3e-5 * scale)
    np.testing.assert_allclose(alpha[smooth], truth.alpha.detach().numpy()[smooth], atol=3e-5)
    # Elsewhere one Gaussian may be drawn by one and not by the other: at the floor, or behind 1% of the light.
    np.testing.assert_allclose(features, expected, atol=0.012 * scale)

    rng = np.random.default_rng(99)
    g_image = rng.normal(size=features.shape).astype(np.float32) * smooth[..., None]
    g_alpha = (rng.normal(size=alpha.shape) * smooth).astype(np.float32)
    ((truth.features * torch.tensor(g_image)).sum() + (truth.alpha * torch.tensor(g_alpha)).sum()).backward()
    found = pull(rasterizer, g_image, g_alpha)
    for name, value, leaf in zip(("means", "factors", "opacities", "features"), found, truth.leaves, strict=False):
        assert leaf.grad is not None
        wanted = leaf.grad.numpy().copy()
        if name == "features" and depth_channel >= 0:
            value[:, depth_channel] = 0  # what the caller put there was replaced
        assert np.isfinite(value).all(), name
        # float32 sums over pixels: relative to the largest gradient of this Gaussian's row, and of the kind.
        row = np.abs(wanted).reshape(len(wanted), -1).max(axis=1).reshape(-1, *[1] * (wanted.ndim - 1))
        error = np.abs(value - wanted) / (2e-3 * row + 2e-5 * np.abs(wanted).max() + 1e-12)
        assert error.max() <= 1, (name, np.unravel_index(error.argmax(), error.shape), error.max())


@pytest.fixture
def two_threads() -> Iterator[None]:
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("NUMBA_NUM_THREADS allows one thread only")
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.mark.parametrize("channels", [4, 8])
@pytest.mark.parametrize(("width", "height"), SIZES)
def test_picture_and_gradients_agree_with_the_twin(width: int, height: int, channels: int) -> None:
    camera = make_camera(width, height, seed=width)
    assert_agrees(make_scene(150, channels, camera, seed=height), camera)


@pytest.mark.parametrize("depth_channel", [0, 3])
def test_depth_channel_agrees_with_the_twin(depth_channel: int) -> None:
    camera = make_camera(45, 31, seed=3)
    scene = make_scene(80, 4, camera, seed=4)
    assert_agrees(scene, camera, depth_channel=depth_channel)


def test_other_limits_agree_with_the_twin() -> None:
    camera = make_camera(40, 40, seed=5)
    scene = make_scene(80, 4, camera, seed=6)
    scene.opacities[:40] = 0.9995
    assert_agrees(scene, camera, Limits(alpha_cap=0.999))


@pytest.mark.parametrize("opacity", [0.3, 0.95])
def test_deep_stacks_stop_as_the_twin_does(opacity: float) -> None:
    camera = make_camera(24, 20, seed=7)
    rng = np.random.default_rng(8)
    scene = make_scene(200, 4, camera, seed=9)
    means = rng.normal(0, 0.05, (200, 3)) @ camera.rotation + np.outer(rng.uniform(-0.8, 0.8, 200), camera.rotation[2])
    factors = np.tile(0.25 * np.eye(3), (200, 1, 1))
    scene = scene._replace(
        means=means.astype(np.float32), factors=factors.astype(np.float32),
        opacities=np.full(200, opacity, np.float32),
    )  # fmt: skip
    _, _, alpha = render(scene, camera)
    middle = alpha[6:14, 8:16]
    assert (1 - middle).max() < 5e-2
    assert (1 - middle).min() >= DEFAULT.transmittance_stop * 0.999
    assert_agrees(scene, camera)


def test_every_kind_of_gaussian_was_among_them() -> None:
    # The comparison above means little where nothing is culled, clamped or capped.
    camera = make_camera(64, 48, seed=64)
    scene = make_scene(150, 4, camera, seed=48)
    rasterizer, _, _ = render(scene, camera)
    visible = rasterizer.counts > 0
    uv, depth = camera.project(scene.means)
    outside = (depth > DEFAULT.near) & ((uv < 0) | (uv >= (64, 48))).any(axis=1)
    assert (depth < DEFAULT.near).sum() >= 3
    assert not visible[depth < DEFAULT.near].any()
    assert (scene.opacities < DEFAULT.alpha_floor).sum() >= 3
    assert not visible[scene.opacities < DEFAULT.alpha_floor].any()
    assert (outside & visible).any()
    assert (outside & ~visible).any()
    assert (scene.opacities > DEFAULT.alpha_cap).sum() >= 5


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 1.3])
@pytest.mark.parametrize("length", [0.2, 1.0, 5.0])
def test_needles_are_culled_exactly(angle: float, length: float) -> None:
    """A needle across many tiles: whatever the twin draws clearly is drawn, whatever it does not is not."""
    camera = Camera("c", np.array([[80.0, 0, 60], [0, 80, 45], [0, 0, 1]]), np.eye(4), 120, 90)
    turn = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    scene = Scene(
        np.array([[0.03, -0.02, 1.0]], np.float32),
        (turn * [length, 1e-4, 1e-4])[None].astype(np.float32),
        np.array([0.9], np.float32),
        np.ones((1, 4), np.float32),
        np.zeros(4, np.float32),
    )
    expected = twin_of(scene, camera).alpha.detach().numpy()
    _, _, alpha = render(scene, camera)
    assert alpha[expected > 1.05 * DEFAULT.alpha_floor].min() > 0
    assert alpha[expected == 0].max(initial=0) < 1.05 * DEFAULT.alpha_floor
    # Float32 conics of long needles cancel: the quadratic form is good to about 1e-7 times its terms.
    np.testing.assert_allclose(alpha, expected, atol=5e-3)


def test_equal_depths_keep_row_order() -> None:
    camera = Camera("c", np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), np.eye(4), 16, 16)
    rng = np.random.default_rng(0)
    scene = Scene(
        np.tile(np.array([0, 0, 2], np.float32), (40, 1)),
        np.tile(0.2 * np.eye(3, dtype=np.float32), (40, 1, 1)),
        np.full(40, 0.2, np.float32),
        rng.uniform(0, 1, (40, 4)).astype(np.float32),
        np.zeros(4, np.float32),
    )
    _, features, _ = render(scene, camera)
    alpha = 0.2 * np.exp(-0.5 * 2 * 0.25 / (4.0 + 0.3))
    weights = alpha * (1 - alpha) ** np.arange(40)
    np.testing.assert_allclose(features[8, 8], weights @ scene.features, atol=1e-5)


def test_nothing_to_draw_is_the_background_and_has_no_gradient() -> None:
    camera = make_camera(20, 18)
    scene = make_scene(10, 4, camera)
    scene.opacities[:] = 0.5 / 255
    rasterizer, features, alpha = render(scene, camera)
    np.testing.assert_array_equal(features, np.broadcast_to(scene.background, features.shape))
    np.testing.assert_array_equal(alpha, 0)
    for gradient in pull(rasterizer, np.ones_like(features), np.ones_like(alpha)):
        np.testing.assert_array_equal(gradient, 0)
    none = Scene(*(array[:0] for array in scene[:4]), scene.background)
    rasterizer, features, _ = render(none, camera)
    np.testing.assert_array_equal(features, np.broadcast_to(scene.background, features.shape))
    assert len(pull(rasterizer, np.ones_like(features), np.ones_like(alpha))[0]) == 0


def test_not_finite_gaussians_are_not_drawn() -> None:
    camera = make_camera(30, 20)
    scene = make_scene(20, 4, camera, seed=2)
    scene.means[3] = np.nan
    scene.means[4] = np.inf
    scene.factors[5] = np.nan
    scene.factors[6] = 1e20
    scene.opacities[7] = np.nan
    rest = np.r_[0:3, 8:20]
    _, features, alpha = render(scene, camera)
    _, expected, expected_alpha = render(Scene(*(array[rest] for array in scene[:4]), scene.background), camera)
    np.testing.assert_array_equal(features, expected)
    np.testing.assert_array_equal(alpha, expected_alpha)


def test_one_and_two_threads_give_the_same_bits(two_threads: None) -> None:
    camera = make_camera(100, 70, seed=11)
    scene = make_scene(600, 4, camera, seed=12)
    rng = np.random.default_rng(13)
    g_image, g_alpha = rng.normal(size=(70, 100, 4)), rng.normal(size=(70, 100))
    results = []
    for count in (1, 2):
        numba.set_num_threads(count)
        rasterizer, features, alpha = render(scene, camera)
        results.append([features, alpha, *pull(rasterizer, g_image, g_alpha)])
    for one, two in zip(*results, strict=True):
        np.testing.assert_array_equal(one, two)


def test_buffers_of_an_earlier_picture_leave_no_trace() -> None:
    """Sizes that round to the same tiles share buffers: the larger picture's gradients must not stay in the padding."""
    wide, narrow = make_camera(47, 45, seed=1), make_camera(40, 36, seed=1)
    scene = make_scene(60, 4, narrow, seed=3)
    g_image, g_alpha = np.ones((36, 40, 4), np.float32), np.zeros((36, 40), np.float32)
    fresh, _, _ = render(scene, narrow)
    expected = pull(fresh, g_image, g_alpha)
    used = CpuRasterizer()
    used.forward(*scene[:4], CameraArrays.of(wide), scene.background)
    pull(used, np.ones((45, 47, 4), np.float32), np.ones((45, 47), np.float32))
    used.forward(*scene[:4], CameraArrays.of(narrow), scene.background)
    for value, wanted in zip(pull(used, g_image, g_alpha), expected, strict=True):
        np.testing.assert_array_equal(value, wanted)


def test_screen_gradient_is_that_of_the_projected_centre() -> None:
    camera = make_camera(40, 30, seed=2)
    scene = make_scene(60, 4, camera, seed=5)
    truth = twin_of(scene, camera)
    g_image = np.random.default_rng(1).normal(size=(30, 40, 4)).astype(np.float32) * truth.smooth[..., None]
    rasterizer, _, _ = render(scene, camera)
    screen = pull(rasterizer, g_image, np.zeros((30, 40), np.float32))[4]
    means = torch.tensor(scene.means, dtype=torch.float64)
    rest = [torch.tensor(array, dtype=torch.float64) for array in scene[1:]]
    picture = twin.render(
        means.requires_grad_(), *rest[:3], twin.CameraParams.of(camera), rest[3], DEFAULT
    )  # fmt: skip
    (wanted,) = torch.autograd.grad((picture.features * torch.tensor(g_image)).sum(), picture.means)
    visible = rasterizer.counts > 0
    np.testing.assert_allclose(screen[visible], wanted.numpy()[visible], rtol=2e-3, atol=2e-5 * wanted.abs().max())


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("some", [False, True])
def test_gradients_of_features_alone_have_the_bits_of_all_gradients(width: int, height: int, some: bool) -> None:
    camera = make_camera(width, height, seed=width)
    scene = make_scene(150, 4, camera, seed=height)
    arrays = CameraArrays.of(camera)
    learnt = (np.arange(150) % 3 > 0).astype(np.uint8) if some else np.ones(150, np.uint8)
    blocks = np.full(-(-width // 32) * -(-height // 32), 2**64 - 1, np.uint64)
    rasterizer = CpuRasterizer()
    rasterizer.forward(*scene[:3], scene.features, arrays, scene.background, drawing=Drawing(blocks, learnt))
    rng = np.random.default_rng(7)
    planes, alpha = rasterizer.gradient_buffers()
    planes[:, :height, :width] = rng.normal(size=(4, height, width))
    found = rasterizer.feature_gradients(planes).copy()
    wanted = rasterizer.backward(planes, alpha).features
    np.testing.assert_array_equal(found, wanted)
    assert np.count_nonzero(found.any(axis=1)) > 20 or width * height < 100
    assert not found[learnt == 0].any()


def test_gradients_of_features_that_overflow_are_left_out() -> None:
    camera = make_camera(37, 29)
    scene = make_scene(150, 4, camera)
    rasterizer, *_ = render(scene, camera)
    planes, _ = rasterizer.gradient_buffers()
    planes[:, :29, :37] = 1e38
    found = rasterizer.feature_gradients(planes)
    assert np.isfinite(found).all()
    assert rasterizer.guards["gradient_not_finite"] > 0


def test_a_narrow_drawing_draws_the_blocks_that_are_reached() -> None:
    camera = make_camera(100, 90, seed=4)
    scene = make_scene(60, 4, camera, seed=2)
    arrays, learnt = CameraArrays.of(camera), np.zeros(60, np.uint8)
    rasterizer = CpuRasterizer()
    whole = rasterizer.forward(*scene[:3], scene.features, arrays, scene.background)
    wanted, seen = whole.features.copy(), np.flatnonzero(rasterizer.counts)
    tiles_x, everywhere = 4, np.full(12, 2**64 - 1, np.uint64)
    learnt[seen[:3]] = 1
    drawing = Drawing(everywhere, learnt, mask_to_region=True)
    planes = rasterizer.forward(*scene[:3], scene.features, arrays, scene.background, drawing=drawing).features
    drawn = rasterizer.drawn.copy()
    assert not rasterizer.outside_region
    assert drawn.any()
    assert (drawn != everywhere).any()
    shown = np.zeros((90, 100), bool)
    for y, x in np.ndindex(shown.shape):
        shown[y, x] = drawn[y // 32 * tiles_x + x // 32] >> np.uint64(x % 32 // 4 * 8 + y % 32 // 4) & np.uint64(1)
    np.testing.assert_array_equal(planes[:, shown], wanted[:, shown])

    box = (3, 83, 10, 99)  # off the blocks' edges
    here = (slice(None), slice(3, 83), slice(10, 99))
    base = np.random.default_rng(1).random((4, 90, 100), np.float32)
    part, shifts = np.empty((4, 80, 89), np.float32), np.zeros(4)
    for channel, y in np.ndindex(4, 80):
        shifts[channel] += box_loss.compose_row(channel, 3 + y, rasterizer.planes, base, drawn, tiles_x, box, part)
    np.testing.assert_array_equal(part, np.where(shown, planes, base)[here])
    np.testing.assert_allclose(shifts, (part.astype(np.float64) - base[here]).sum(axis=(1, 2)), rtol=1e-5)
    out = np.zeros((4, 96, 128), np.float32)
    for channel, y in np.ndindex(4, 80):
        box_loss.write_row(channel, 3 + y, part, drawn, tiles_x, box, out)
    box_alone = np.zeros_like(shown)
    box_alone[here[1:]] = shown[here[1:]]
    np.testing.assert_array_equal(out[:, :90, :100], np.where(box_alone, planes, 0))

    rasterizer.forward(
        *scene[:3], scene.features, arrays, scene.background, drawing=Drawing(np.zeros(12, np.uint64), learnt, True)
    )
    assert rasterizer.outside_region
