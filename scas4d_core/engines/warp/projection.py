"""EWA projection of Gaussians into a camera, and its backward pass. Reference: ``engines.torch.rasterizer``.

Gaussians with invalid values are not rendered, because they would corrupt every pixel that they cover. Overflowing
gradients are discarded (see ``guards``).
"""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.warp.lanes import load, store, sync_lanes
from scas4d_core.engines.warp.layout import TILE, Camera, Raster
from scas4d_core.engines.warp.supports import SLACK, enter_lists
from scas4d_core.guards import FEATURE_CEILING, FOOTPRINT_CEILING, GRADIENT_NOT_FINITE, NOT_FINITE

wp.set_module_options({"enable_backward": False})

FARTHEST = wp.constant(wp.float32(NOT_FINITE))
BRIGHTEST = wp.constant(wp.float32(FEATURE_CEILING))
WIDEST = wp.constant(wp.float32(FOOTPRINT_CEILING))
STEEPEST = wp.constant(wp.float32(GRADIENT_NOT_FINITE))
COUNTED_GUARDS = ("not_finite", "footprint_ceiling", "gradient_not_finite")
"""Names of the counted guards: ``project`` counts the first two, ``project_backward`` the last."""
RECORD = 4
"""Number of rows per splat in ``records`` [4 N]. The first ten values are sums over pixels: dL/dpower times 1, x, y,
xx, xy and yy, followed by dL/dfeatures. Here, (x, y) is the offset from the mean. The rest is padding to 64 bytes."""


@wp.func
def held(raster: Raster, tangent: wp.float32, focal: wp.float32, centre: wp.float32, size: wp.int32) -> wp.vec2:
    """Returns x/z or y/z, clamped for the Jacobian, and a flag: 1 if the value was within the bounds, otherwise 0."""
    margin = raster.margin * 0.5 * wp.float32(size) / focal
    low = -(centre / focal + margin)
    high = (wp.float32(size) - centre) / focal + margin
    return wp.vec2(wp.clamp(tangent, low, high), wp.where(tangent >= low and tangent <= high, 1.0, 0.0))


@wp.func
def size_of(mean: wp.vec3, factor: wp.mat33, opacity: wp.float32) -> wp.float32:
    """Returns the sum of the absolute values of a Gaussian's parameters. The sum is non-finite if any parameter is."""
    size = wp.abs(mean[0]) + wp.abs(mean[1]) + wp.abs(mean[2]) + wp.abs(opacity)
    for row in range(3):
        size += wp.abs(factor[row, 0]) + wp.abs(factor[row, 1]) + wp.abs(factor[row, 2])
    return size


@wp.func
def sound(mean: wp.vec3, factor: wp.mat33, opacity: wp.float32, feature: wp.vec4) -> wp.bool:
    """Returns whether a Gaussian's values are finite and within the bounds on distance, size and brightness."""
    return (
        size_of(mean, factor, opacity) <= FARTHEST
        and wp.abs(feature[0]) <= BRIGHTEST
        and wp.abs(feature[1]) <= BRIGHTEST
        and wp.abs(feature[2]) <= BRIGHTEST
        and wp.abs(feature[3]) <= BRIGHTEST
    )


@wp.func
def project_one(
    raster: Raster, camera: Camera, i: wp.int32, means: wp.array[wp.vec3], factors: wp.array[wp.mat33],
    opacities: wp.array[wp.float32], features: wp.array[wp.vec4], splats: wp.array[wp.vec4],
    boxes: wp.array[wp.vec4i], records: wp.array[wp.vec4], guard_counts: wp.array[wp.int32],
) -> wp.int32:  # fmt: skip
    """Projects a Gaussian. Returns 1 if its bounding box intersects the image, otherwise 0. See ``project``."""
    zero = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(3):
        store(records, RECORD * i + k, zero)
    mean = means[i]
    factor = factors[i]
    opacity = opacities[i]
    place = camera.rotation * mean + camera.translation
    second = zero
    drawn = wp.int32(0)
    # Comparisons with NaN are always false.
    fit = sound(mean, factor, opacity, features[i])
    if not fit:
        wp.atomic_add(guard_counts, 0, 1)
    if fit and place[2] >= raster.near and opacity >= raster.alpha_floor:
        inverse = 1.0 / place[2]
        u = held(raster, place[0] * inverse, camera.fx, camera.cx, camera.width)[0]
        v = held(raster, place[1] * inverse, camera.fy, camera.cy, camera.height)[0]
        axes = camera.rotation * factor
        m0 = camera.fx * inverse * (axes[0] - u * axes[2])
        m1 = camera.fy * inverse * (axes[1] - v * axes[2])
        xx = wp.dot(m0, m0) + raster.low_pass
        yy = wp.dot(m1, m1) + raster.low_pass
        xy = wp.dot(m0, m1)
        # Avoids the cancellation of xx yy − xy² for needle-shaped Gaussians.
        normal = wp.cross(m0, m1)
        determinant = wp.dot(normal, normal) + raster.low_pass * (xx + yy - raster.low_pass)
        if not (determinant > 0.0 and determinant < WIDEST):
            wp.atomic_add(guard_counts, 1, 1)
        else:
            x = camera.fx * place[0] * inverse + camera.cx
            y = camera.fy * place[1] * inverse + camera.cy
            log_opacity = wp.log(opacity)
            reach = wp.max(2.0 * (log_opacity - raster.log_floor), 0.0)
            half_x = wp.sqrt(reach * xx) + 0.5
            half_y = wp.sqrt(reach * yy) + 0.5
            width = wp.float32(camera.width)
            height = wp.float32(camera.height)
            if x + half_x > 0.0 and x - half_x < width and y + half_y > 0.0 and y - half_y < height:
                drawn = wp.int32(1)
                second = wp.vec4(xx / determinant, log_opacity, reach * (1.0 + SLACK) + SLACK, place[2])
                x0 = wp.int32(wp.max(x - half_x, 0.0)) // TILE
                y0 = wp.int32(wp.max(y - half_y, 0.0)) // TILE
                x1 = wp.int32(wp.min(x + half_x, width - 1.0)) // TILE + 1
                y1 = wp.int32(wp.min(y + half_y, height - 1.0)) // TILE + 1
                boxes[i] = wp.vec4i(x0, y0, x1, y1)
                store(splats, 2 * i, wp.vec4(x, y, yy / determinant, -xy / determinant))
    store(splats, 2 * i + 1, second)
    return drawn


@wp.kernel
def project(
    raster: Raster,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    means: wp.array[wp.vec3],
    factors: wp.array[wp.mat33],
    opacities: wp.array[wp.float32],
    features: wp.array[wp.vec4],
    splats: wp.array[wp.vec4],
    boxes: wp.array[wp.vec4i],
    records: wp.array[wp.vec4],
    guard_counts: wp.array[wp.int32],
    tile_counts: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    keys: wp.array[wp.uint64],
) -> None:
    """Projects N Gaussians with one thread each, and counts the entries of each tile list.

    The kernel is launched in whole warps.

    Args:
        raster: rasterizer constants.
        cameras: [views] cameras of all views.
        view: [1] index of the view.
        means: [N] means, in metres.
        factors: [N] covariance factors F, with Σ = F Fᵀ.
        opacities: [N] opacities.
        features: [N] features, which are only checked for invalid values.
        splats: [2 N] output, splats; see ``supports``.
        boxes: [N] output, bounding box of each support in tiles: x0, y0, x1, y1 (exclusive). It is undefined if the
            Gaussian is culled.
        records: [4 N] gradient records, reset to 0.
        guard_counts: [3] number of times each guard in ``COUNTED_GUARDS`` was triggered, accumulated.
        tile_counts: [tiles] number of entries in each list, accumulated.
        starts, keys: arguments for ``enter_lists``, which does not use them while counting.
    """
    i = wp.tid()
    camera = cameras[view[0]]
    drawn = wp.int32(0)
    if i < raster.count:
        drawn = project_one(
            raster, camera, i, means, factors, opacities, features, splats, boxes, records, guard_counts
        )
    sync_lanes()
    enter_lists(raster, camera, i, drawn, splats, boxes, starts, tile_counts, keys, 0)


@wp.kernel
def project_backward(
    raster: Raster,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    means: wp.array[wp.vec3],
    factors: wp.array[wp.mat33],
    splats: wp.array[wp.vec4],
    records: wp.array[wp.vec4],
    guard_counts: wp.array[wp.int32],
    adds: wp.int32,
    g_means: wp.array[wp.vec3],
    g_factors: wp.array[wp.mat33],
    g_features: wp.array[wp.vec4],
) -> None:
    """Backpropagates the splat gradients to the Gaussians, with one thread per Gaussian.

    Args:
        raster, cameras, view, means, factors: see ``project``.
        splats: [2 N] output of ``project``.
        records: [4 N] output of ``blend_backward``.
        guard_counts: [3] number of times each guard in ``COUNTED_GUARDS`` was triggered, accumulated.
        adds: 1 to add to the gradients, 0 to overwrite them.
        g_means, g_factors, g_features: [N] outputs, gradients of the Gaussians.
    """
    i = wp.tid()
    second = load(splats, 2 * i + 1)
    if adds == 0:
        g_means[i] = wp.vec3(0.0, 0.0, 0.0)
        g_factors[i] = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        g_features[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if second[2] > 0.0:
        first = load(splats, 2 * i)
        r0 = load(records, RECORD * i)
        r1 = load(records, RECORD * i + 1)
        r2 = load(records, RECORD * i + 2)
        camera = cameras[view[0]]
        place = camera.rotation * means[i] + camera.translation
        inverse = 1.0 / place[2]
        at_u = held(raster, place[0] * inverse, camera.fx, camera.cx, camera.width)
        at_v = held(raster, place[1] * inverse, camera.fy, camera.cy, camera.height)
        u = at_u[0]
        v = at_v[0]
        a = first[2]
        b = first[3]
        c = second[0]
        gx = a * r0[1] + b * r0[2]
        gy = b * r0[1] + c * r0[2]
        # dL/dcov2d = −conic dL/dconic conic, where all matrices are symmetric.
        ga = -0.5 * r0[3]
        gb = -0.5 * r1[0]
        gc = -0.5 * r1[1]
        p00 = a * ga + b * gb
        p01 = a * gb + b * gc
        p10 = b * ga + c * gb
        p11 = b * gb + c * gc
        s00 = -(p00 * a + p01 * b)
        s01 = -(p00 * b + p01 * c)
        s11 = -(p10 * b + p11 * c)
        axes = camera.rotation * factors[i]
        m0 = camera.fx * inverse * (axes[0] - u * axes[2])
        m1 = camera.fy * inverse * (axes[1] - v * axes[2])
        gm0 = 2.0 * (s00 * m0 + s01 * m1)
        gm1 = 2.0 * (s01 * m0 + s11 * m1)
        g_axis0 = camera.fx * inverse * gm0
        g_axis1 = camera.fy * inverse * gm1
        g_axis2 = -(u * g_axis0 + v * g_axis1)
        # Clamped tangents are treated as constants, but the projected mean always receives a gradient.
        g_place0 = camera.fx * inverse * gx - at_u[1] * inverse * wp.dot(g_axis0, axes[2])
        g_place1 = camera.fy * inverse * gy - at_v[1] * inverse * wp.dot(g_axis1, axes[2])
        g_place2 = -inverse * (wp.dot(gm0, m0) + wp.dot(gm1, m1) + place[0] * g_place0 + place[1] * g_place1)
        back = wp.transpose(camera.rotation)
        g_mean = back * wp.vec3(g_place0, g_place1, g_place2)
        g_factor = back * wp.matrix_from_rows(g_axis0, g_axis1, g_axis2)
        g_feature = wp.vec4(r1[2], r1[3], r2[0], r2[1])
        bright = wp.abs(g_feature[0]) + wp.abs(g_feature[1]) + wp.abs(g_feature[2]) + wp.abs(g_feature[3])
        if size_of(g_mean, g_factor, bright) <= STEEPEST:
            g_means[i] = g_means[i] + g_mean
            g_factors[i] = g_factors[i] + g_factor
            g_features[i] = g_features[i] + g_feature
        else:
            wp.atomic_add(guard_counts, 2, 1)
