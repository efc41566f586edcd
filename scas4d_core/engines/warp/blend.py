"""Front-to-back blending of four features per tile, and its backward pass.

A tile has 16×16 pixels, and each warp renders a block of 8×4 pixels. Every lane tests one list entry, and the warp then
blends the entries whose support intersects its block. On the CPU device, a warp has one lane and renders one pixel.

A few tiles account for most of the work, so lists are split into segments that are blended in parallel.
``blend_segments`` blends each segment as if it were the first, and ``join_segments`` combines the segments. If a pixel
is finished within a segment, the segment is blended again for this pixel, up to the finishing entry. The state at the
start of each segment is kept for the backward pass.
"""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.warp.lanes import (
    ballot,
    broadcast,
    fast_divide,
    fast_exp,
    lane,
    lane_count,
    load,
    lowest,
    store,
)
from scas4d_core.engines.warp.layout import PIXELS, SEGMENT, TILE, Camera, Raster
from scas4d_core.engines.warp.projection import RECORD
from scas4d_core.engines.warp.supports import least_form

wp.set_module_options({"enable_backward": False})

NONE = wp.constant(wp.uint32(0))
ONE = wp.constant(wp.uint32(1))


@wp.struct
class Spot:
    """A lane's pixel: position, centre, whether it is inside the image, and the first pixel centre of its warp."""

    x: wp.int32
    y: wp.int32
    inside: wp.int32
    centre_x: wp.float32
    centre_y: wp.float32
    left: wp.float32
    top: wp.float32


@wp.func
def spot_of(raster: Raster, camera: Camera, tile: wp.int32, k: wp.int32) -> Spot:
    """Returns the k-th pixel of a tile. Each 8×4 block consists of 32 consecutive pixels."""
    group = k // 32
    within = k - group * 32
    x0 = (tile % raster.tiles_x) * TILE + (group % 2) * 8
    y0 = (tile // raster.tiles_x) * TILE + (group // 2) * 4
    spot = Spot()
    spot.x = x0 + within % 8
    spot.y = y0 + within // 8
    spot.inside = wp.where(spot.x < camera.width and spot.y < camera.height, 1, 0)
    spot.centre_x = wp.float32(spot.x) + 0.5
    spot.centre_y = wp.float32(spot.y) + 0.5
    spot.left = spot.centre_x
    spot.top = spot.centre_y
    if lane_count() > 1:
        spot.left = wp.float32(x0) + 0.5
        spot.top = wp.float32(y0) + 0.5
    return spot


@wp.func
def meets(spot: Spot, first: wp.vec4, second: wp.vec4) -> wp.int32:
    """Returns 1 if a splat's support intersects the warp's pixels, otherwise 0."""
    met = wp.int32(0)
    if second[2] > 0.0:
        across = wp.where(lane_count() > 1, 7.0, 0.0)
        down = wp.where(lane_count() > 1, 3.0, 0.0)
        left = spot.left - first[0]
        top = spot.top - first[1]
        form = least_form(first[2], first[3], second[0], left, left + across, top, top + down)
        if form <= second[2]:
            met = wp.int32(1)
    return met


@wp.func
def power_at(first: wp.vec4, second: wp.vec4, dx: wp.float32, dy: wp.float32) -> wp.float32:
    """Returns the logarithm of a splat's alpha at an offset from its mean."""
    return second[1] - 0.5 * (first[2] * dx * dx + second[0] * dy * dy) - first[3] * dx * dy


@wp.struct
class Light:
    """State of a pixel during blending: transmittance, accumulated features, and whether the pixel is unfinished."""

    passed: wp.float32
    features: wp.vec4
    open: wp.int32


@wp.func
def draw_entries(
    raster: Raster,
    splats: wp.array[wp.vec4],
    features: wp.array[wp.vec4],
    items: wp.array[wp.int32],
    begin: wp.int32,
    end: wp.int32,
    spot: Spot,
    open: wp.int32,
    passed: wp.float32,
    exact: wp.int32,
) -> Light:
    """Blends list entries front to back, starting from a given transmittance.

    All lanes of a warp must call this function.

    Args:
        raster, splats, features, items: see ``blend_segments``.
        begin, end: first entry, and last entry plus 1.
        spot: pixel of the lane.
        open: 1 if the lane's pixel must be rendered, otherwise 0.
        passed: transmittance before the first entry.
        exact: determines the transmittance returned for a pixel that these entries finish. If 0, the value is below the
            stop. If 1, it is the value before the entry that finishes the pixel.
    """
    light = Light()
    light.passed = passed
    light.open = open
    base = wp.int32(begin)
    alive = ballot(light.open)
    # The next candidates and the next entry to blend are loaded early to hide memory latency.
    item = wp.int32(0)
    first = wp.vec4(0.0, 0.0, 0.0, 0.0)
    second = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if base + lane() < end:
        item = items[base + lane()]
        first = load(splats, 2 * item)
        second = load(splats, 2 * item + 1)
    while base < end and alive != NONE:
        candidates = ballot(meets(spot, first, second))
        mine = item
        base += lane_count()
        second = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if base + lane() < end:
            item = items[base + lane()]
            first = load(splats, 2 * item)
            second = load(splats, 2 * item + 1)
        ahead = broadcast(mine, lowest(candidates))
        next_first = load(splats, 2 * ahead)
        next_second = load(splats, 2 * ahead + 1)
        next_features = load(features, ahead)
        while candidates != NONE:
            here = next_first
            shape = next_second
            feature = next_features
            candidates = candidates & (candidates - ONE)
            ahead = broadcast(mine, lowest(candidates))
            next_first = load(splats, 2 * ahead)
            next_second = load(splats, 2 * ahead + 1)
            next_features = load(features, ahead)
            power = power_at(here, shape, spot.centre_x - here[0], spot.centre_y - here[1])
            if light.open == 1 and power >= raster.log_floor:
                weight = wp.min(fast_exp(power), raster.alpha_cap) * light.passed
                after = light.passed - weight
                if after < raster.stop:
                    light.open = 0
                    if exact == 0:
                        light.passed = after
                else:
                    light.passed = after
                    light.features = light.features + weight * feature
        alive = ballot(light.open)
    return light


@wp.kernel
def count_pairs(
    raster: Raster,
    splats: wp.array[wp.vec4],
    items: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    every: wp.int32,
    pairs: wp.array2d[wp.int32],
) -> None:
    """Counts the Gaussians that are blended into pixels, with one thread per pixel.

    Args:
        raster, splats, items, starts: see ``blend_segments``.
        every: step between the rows and columns that are counted.
        pairs: [rows, columns] output.
    """
    row, column = wp.tid()
    y = row * every
    x = column * every
    tile = (y // TILE) * raster.tiles_x + x // TILE
    passed = wp.float32(1.0)
    count = wp.int32(0)
    entry = starts[tile]
    while entry < starts[tile + 1] and passed >= raster.stop:
        first = load(splats, 2 * items[entry])
        second = load(splats, 2 * items[entry] + 1)
        power = power_at(first, second, wp.float32(x) + 0.5 - first[0], wp.float32(y) + 0.5 - first[1])
        if power >= raster.log_floor:
            passed -= wp.min(fast_exp(power), raster.alpha_cap) * passed
            if passed >= raster.stop:
                count += 1
        entry += 1
    pairs[row, column] = count


@wp.kernel(launch_bounds=(PIXELS, 3))
def blend_segments(
    raster: Raster,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    splats: wp.array[wp.vec4],
    features: wp.array[wp.vec4],
    items: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    segment_starts: wp.array[wp.int32],
    segment_tiles: wp.array[wp.int32],
    warps: wp.int32,
    segment_light: wp.array[wp.float32],
    segment_features: wp.array[wp.vec4],
) -> None:
    """Blends each segment independently. Each warp processes one 8×4 block of one segment after another.

    Args:
        raster, cameras, view: see ``projection.project``.
        splats: [2 N] splats; see ``supports``.
        features: [N] features of the Gaussians.
        items, starts, segment_starts, segment_tiles: tile lists; see ``tiles``.
        warps: number of warps in the launch.
        segment_light: [segments · 256] output, transmittance of each segment at each pixel of its tile. The value is
            below the stop if this segment alone finishes the pixel.
        segment_features: [segments · 256] output, blended features of each segment at each pixel of its tile.
    """
    parts = PIXELS // lane_count()
    total = segment_starts[raster.tiles_x * raster.tiles_y] * parts
    unit = wp.int32(wp.tid() // lane_count())
    while unit < total:
        segment = unit // parts
        k = (unit - segment * parts) * lane_count() + lane()
        tile = segment_tiles[segment]
        begin = starts[tile] + (segment - segment_starts[tile]) * SEGMENT
        spot = spot_of(raster, cameras[view[0]], tile, k)
        light = draw_entries(
            raster, splats, features, items, begin, wp.min(begin + SEGMENT, starts[tile + 1]), spot, spot.inside, 1.0, 0
        )
        segment_light[segment * PIXELS + k] = light.passed
        store(segment_features, segment * PIXELS + k, light.features)
        unit += warps


@wp.kernel(launch_bounds=(PIXELS, 3))
def join_segments(
    raster: Raster,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    splats: wp.array[wp.vec4],
    features: wp.array[wp.vec4],
    items: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    segment_starts: wp.array[wp.int32],
    background: wp.array[wp.vec4],
    segment_light: wp.array[wp.float32],
    segment_features: wp.array[wp.vec4],
    begun: wp.array2d[wp.int32],
    planes: wp.array3d[wp.float32],
) -> None:
    """Combines the segments of each list, with one thread per pixel of each tile.

    Args:
        raster, cameras, view, splats, features, items, starts, segment_starts: see ``blend_segments``.
        background: [1] background features.
        segment_light, segment_features: outputs of ``blend_segments``. While a pixel is unfinished, they are replaced
            by the pixel's state at the start of each segment.
        begun: [rows, columns] output, number of segments at whose start the pixel was unfinished.
        planes: [5, rows, columns] output, features including the background, and remaining transmittance.
    """
    camera = cameras[view[0]]
    tile = wp.tid() // PIXELS
    k = wp.tid() - tile * PIXELS
    spot = spot_of(raster, camera, tile, k)
    light = Light()
    light.passed = 1.0
    light.open = spot.inside
    begin = starts[tile]
    end = starts[tile + 1]
    segments = segment_starts[tile + 1] - segment_starts[tile]
    at = segment_starts[tile] * PIXELS + k
    count = wp.int32(0)
    segment = wp.int32(0)
    # The next segment is loaded early to hide memory latency.
    next_passed = wp.float32(1.0)
    next_drawn = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if segments > 0:
        next_passed = segment_light[at]
        next_drawn = load(segment_features, at)
    while segment < segments and ballot(light.open) != NONE:
        passed = next_passed
        drawn = next_drawn
        if segment + 1 < segments:
            next_passed = segment_light[at + PIXELS]
            next_drawn = load(segment_features, at + PIXELS)
        anew = wp.int32(0)
        if light.open == 1:
            segment_light[at] = light.passed
            store(segment_features, at, light.features)
            count = segment + 1
            if light.passed * passed >= raster.stop:
                light.features = light.features + light.passed * drawn
                light.passed = light.passed * passed
            else:
                anew = wp.int32(1)
        if ballot(anew) != NONE:
            again = draw_entries(
                raster, splats, features, items, begin, wp.min(begin + SEGMENT, end), spot, anew, light.passed, 1
            )
            if anew == 1:
                light.passed = again.passed
                light.features = light.features + again.features
                light.open = again.open
        begin += SEGMENT
        at += PIXELS
        segment += 1
    if spot.inside == 1:
        begun[spot.y, spot.x] = count
        shown = light.features + light.passed * background[0]
        for channel in range(4):
            planes[channel, spot.y, spot.x] = shown[channel]
        planes[4, spot.y, spot.x] = light.passed


# Transposing butterfly reduction: ten sums over 32 lanes become five over 16, three over 8, two over 4 and one over 2.
# All indices are known at compile time, so the values stay in registers.
@wp.func_native("""
float* record = reinterpret_cast<float*>(records.data + row);
#if defined(__CUDA_ARCH__)
float v[10] = {a0, a1, a2, a3, a4, a5, a6, a7, a8, a9};
const int own = threadIdx.x & 31;
const auto fold = [&](const int count, const int half, const int bit) {
    const bool upper = own & bit;
#pragma unroll
    for (int k = 0; k < 5; ++k)
        if (k < half) {
            const float far = k + half < count ? v[k + half] : 0.f;
            const float given = upper ? v[k] : far, kept = upper ? far : v[k];
            v[k] = kept + __shfl_xor_sync(0xffffffffu, given, bit);
        }
};
fold(10, 5, 16);
fold(5, 3, 8);
fold(3, 2, 4);
fold(2, 1, 2);
v[0] += __shfl_xor_sync(0xffffffffu, v[0], 1);
const int last = (own & 4 ? 2 : 0) + (own & 2 ? 1 : 0);
const int which = (own & 16 ? 5 : 0) + (own & 8 ? 3 : 0) + last;
if (!(own & 1) && last < (own & 8 ? 2 : 3)) atomicAdd(record + which, v[0]);
#else
const float v[10] = {a0, a1, a2, a3, a4, a5, a6, a7, a8, a9};
for (int k = 0; k < 10; ++k) record[k] += v[k];
#endif
""")
def add_record(
    records: wp.array[wp.vec4], row: wp.int32, a0: wp.float32, a1: wp.float32, a2: wp.float32, a3: wp.float32,
    a4: wp.float32, a5: wp.float32, a6: wp.float32, a7: wp.float32, a8: wp.float32, a9: wp.float32,
) -> None:  # fmt: skip
    """Sums ten numbers over the lanes and adds the sums to the record that starts at ``row``."""
    ...


@wp.kernel(launch_bounds=(PIXELS, 3))
def blend_backward(
    raster: Raster,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    splats: wp.array[wp.vec4],
    features: wp.array[wp.vec4],
    items: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    segment_starts: wp.array[wp.int32],
    segment_tiles: wp.array[wp.int32],
    warps: wp.int32,
    segment_light: wp.array[wp.float32],
    segment_features: wp.array[wp.vec4],
    begun: wp.array2d[wp.int32],
    planes: wp.array3d[wp.float32],
    g_planes: wp.array3d[wp.float32],
    records: wp.array[wp.vec4],
) -> None:
    """Backpropagates the gradient of the planes to the splats. Work is distributed as in the forward pass.

    Args:
        raster, cameras, view, splats, features, items, starts: see ``blend_segments``.
        segment_starts, segment_tiles, warps: see ``blend_segments``.
        segment_light, segment_features, begun, planes: outputs of ``join_segments``.
        g_planes: [4, rows, columns] dL/dplanes for the features.
        records: [4 N] gradient records, accumulated; see ``projection``.
    """
    parts = PIXELS // lane_count()
    total = segment_starts[raster.tiles_x * raster.tiles_y] * parts
    unit = wp.int32(wp.tid() // lane_count())
    while unit < total:
        segment = unit // parts
        k = (unit - segment * parts) * lane_count() + lane()
        tile = segment_tiles[segment]
        number = segment - segment_starts[tile]
        base = starts[tile] + number * SEGMENT
        end = wp.min(base + SEGMENT, starts[tile + 1])
        spot = spot_of(raster, cameras[view[0]], tile, k)
        open = wp.int32(0)
        passed = wp.float32(1.0)
        behind = wp.float32(0.0)  # contribution of later entries and background
        g = wp.vec4(0.0, 0.0, 0.0, 0.0)
        label = wp.float32(0.0)  # part of g[3] that affects the blending weights; a second vector would spill registers
        if spot.inside == 1:  # noqa: SIM102  # Warp reads both sides of an `and`
            if number < begun[spot.y, spot.x]:
                g = wp.vec4(
                    g_planes[0, spot.y, spot.x], g_planes[1, spot.y, spot.x], g_planes[2, spot.y, spot.x],
                    g_planes[3, spot.y, spot.x],
                )  # fmt: skip
                shown = wp.vec4(
                    planes[0, spot.y, spot.x], planes[1, spot.y, spot.x], planes[2, spot.y, spot.x],
                    planes[3, spot.y, spot.x],
                )  # fmt: skip
                label = wp.where(raster.detached == 1, 0.0, g[3])
                passed = segment_light[segment * PIXELS + k]
                later = shown - load(segment_features, segment * PIXELS + k)
                behind = g[0] * later[0] + g[1] * later[1] + g[2] * later[2] + label * later[3]
                if g[0] != 0.0 or g[1] != 0.0 or g[2] != 0.0 or g[3] != 0.0:
                    open = wp.int32(1)
        alive = ballot(open)
        item = wp.int32(0)
        first = wp.vec4(0.0, 0.0, 0.0, 0.0)
        second = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if alive != NONE and base + lane() < end:
            item = items[base + lane()]
            first = load(splats, 2 * item)
            second = load(splats, 2 * item + 1)
        while base < end and alive != NONE:
            candidates = ballot(meets(spot, first, second))
            mine = item
            base += lane_count()
            second = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if base + lane() < end:
                item = items[base + lane()]
                first = load(splats, 2 * item)
                second = load(splats, 2 * item + 1)
            ahead = broadcast(mine, lowest(candidates))
            next_first = load(splats, 2 * ahead)
            next_second = load(splats, 2 * ahead + 1)
            next_features = load(features, ahead)
            while candidates != NONE:
                row = ahead
                here = next_first
                shape = next_second
                feature = next_features
                candidates = candidates & (candidates - ONE)
                ahead = broadcast(mine, lowest(candidates))
                next_first = load(splats, 2 * ahead)
                next_second = load(splats, 2 * ahead + 1)
                next_features = load(features, ahead)
                dx = spot.centre_x - here[0]
                dy = spot.centre_y - here[1]
                power = power_at(here, shape, dx, dy)
                weight = wp.float32(0.0)
                g_power = wp.float32(0.0)
                drawn = wp.int32(0)
                if open == 1 and power >= raster.log_floor:
                    alpha = wp.min(fast_exp(power), raster.alpha_cap)
                    weight = alpha * passed
                    after = passed - weight
                    if after < raster.stop:
                        open = wp.int32(0)
                        weight = wp.float32(0.0)
                    else:
                        passed = after
                        drawn = wp.int32(1)
                        own = g[0] * feature[0] + g[1] * feature[1] + g[2] * feature[2] + label * feature[3]
                        own = weight * own
                        behind -= own
                        if alpha < raster.alpha_cap:
                            g_power = own - behind * fast_divide(alpha, 1.0 - alpha)
                if ballot(drawn) != NONE:
                    gx = g_power * dx
                    gy = g_power * dy
                    add_record(
                        records, RECORD * row, g_power, gx, gy, gx * dx, gx * dy, gy * dy, weight * g[0],
                        weight * g[1], weight * g[2], weight * g[3],
                    )  # fmt: skip
            alive = ballot(open)
        unit += warps
