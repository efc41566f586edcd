"""Tile lists, which contain the Gaussians of each tile, sorted by depth and then by row.

Projection counts the entries of each list. ``place_lists`` then computes the offsets, ``fill_lists`` writes the
entries, and ``sort_lists`` sorts each list. Lists are divided into segments of ``SEGMENT`` entries, which are blended
in parallel.
"""

from __future__ import annotations

import warp as wp

from scas4d_core.engines.warp.lanes import load
from scas4d_core.engines.warp.layout import COLUMNS, PAIRS, SEGMENT, TILE, Camera, Raster
from scas4d_core.engines.warp.supports import enter_lists, least_form

wp.set_module_options({"enable_backward": False})

SCAN_BLOCK = 1024
"""Number of threads in the single block that computes the list offsets."""
SORT_BLOCK = 512
"""Number of threads in a block that sorts a list."""


@wp.func_native("""
const int tiles = counts.shape[0];
#if defined(__CUDA_ARCH__)
__shared__ long long entries[1024];
__shared__ int parts[1024];
const int share = (tiles + blockDim.x - 1) / blockDim.x;
const int first = min((int)thread * share, tiles), last = min(first + share, tiles);
#else
const int first = 0, last = tiles;
#endif
long long entry = 0;
int part = 0;
for (int tile = first; tile < last; ++tile) {
    entry += counts.data[tile];
    part += (counts.data[tile] + length - 1) / length;
}
#if defined(__CUDA_ARCH__)
const long long own_entries = entry;
const int own_parts = part;
entries[thread] = entry;
parts[thread] = part;
__syncthreads();
for (int step = 1; step < blockDim.x; step <<= 1) {
    const long long entries_before = thread >= step ? entries[thread - step] : 0;
    const int parts_before = thread >= step ? parts[thread - step] : 0;
    __syncthreads();
    entries[thread] += entries_before;
    parts[thread] += parts_before;
    __syncthreads();
}
const long long total = entries[blockDim.x - 1];
entry = entries[thread] - own_entries;
part = parts[thread] - own_parts;
const bool ends = thread == blockDim.x - 1;
#else
const long long total = entry;
const bool ends = true;
entry = part = 0;
#endif
const bool fits = total <= capacity;
for (int tile = first; tile < last; ++tile) {
    const int count = counts.data[tile];
    starts.data[tile] = fits ? (int)entry : 0;
    segment_starts.data[tile] = fits ? part : 0;
    entry += count;
    part += (count + length - 1) / length;
    counts.data[tile] = 0;
}
if (ends) {
    starts.data[tiles] = fits ? (int)entry : 0;
    segment_starts.data[tiles] = fits ? part : 0;
}
return fits ? (float)total : 1.25f * (float)total;
""")
def scan_lists(
    thread: wp.int32, capacity: wp.int32, length: wp.int32, counts: wp.array[wp.int32], starts: wp.array[wp.int32],
    segment_starts: wp.array[wp.int32],
) -> wp.float32:  # fmt: skip
    """Implements ``place_lists`` and returns the value for ``PAIRS``. All threads of the block must call it."""
    ...


@wp.kernel(module="unique", enable_backward=False)
def place_lists(
    threads: wp.int32,
    raster: Raster,
    tile_counts: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    segment_starts: wp.array[wp.int32],
    record: wp.array[wp.int32],
    log: wp.array2d[wp.float32],
) -> None:
    """Computes the first entry and the first segment of each list.

    The kernel is launched as a single block.

    Args:
        threads: number of threads in the block, 1 on the CPU device.
        raster: rasterizer constants.
        tile_counts: [tiles] number of entries in each list, reset to 0.
        starts, segment_starts: [tiles + 1] outputs, first entry and first segment of each list. If the lists exceed the
            capacity, all values are 0.
        record: [1] row of the log to initialize.
        log: [records, ``COLUMNS``] log.
    """
    room = scan_lists(wp.tid(), raster.capacity, SEGMENT, tile_counts, starts, segment_starts)
    if wp.tid() == threads - 1:
        for column in range(COLUMNS):
            log[record[0], column] = 0.0
        log[record[0], PAIRS] = room


@wp.kernel
def fill_lists(
    raster: Raster,
    cameras: wp.array[Camera],
    view: wp.array[wp.int32],
    splats: wp.array[wp.vec4],
    boxes: wp.array[wp.vec4i],
    starts: wp.array[wp.int32],
    tile_counts: wp.array[wp.int32],
    keys: wp.array[wp.uint64],
) -> None:
    """Writes the list entries in arbitrary order, with one thread per Gaussian.

    The kernel is launched in whole warps.

    Args:
        raster: rasterizer constants.
        cameras: [views] cameras of all views.
        view: [1] index of the view.
        splats, boxes: outputs of ``projection.project``.
        starts: [tiles + 1] output of ``place_lists``.
        tile_counts: [tiles] counters, initially 0, incremented to the number of entries in each list.
        keys: [capacity] output, depth and row of each entry. Sorting the keys orders entries by depth, then by row.
    """
    i = wp.tid()
    drawn = wp.int32(0)
    if i < raster.count and starts[raster.tiles_x * raster.tiles_y] > 0:
        drawn = wp.where(load(splats, 2 * i + 1)[2] > 0.0, 1, 0)
    enter_lists(raster, cameras[view[0]], i, drawn, splats, boxes, starts, tile_counts, keys, 1)


# Bitonic sort with all comparisons in the same direction, so that virtual elements past the end never move.
@wp.func_native("""
unsigned long long* list = reinterpret_cast<unsigned long long*>(keys.data) + first;
#if defined(__CUDA_ARCH__)
__shared__ unsigned long long shared[4096];
const int threads = blockDim.x;
unsigned long long* a = list;
if (count <= 4096) {
    a = shared;
    for (int i = thread; i < count; i += threads) shared[i] = list[i];
    __syncthreads();
}
int whole = 1;
while (whole < count) whole <<= 1;
for (int run = 2; run <= whole; run <<= 1)
    for (int step = run >> 1; step > 0; step >>= 1) {
        const int mirror = step == (run >> 1) ? run - 1 : step;
        for (int i = thread; i < (whole >> 1); i += threads) {
            const int x = ((i & ~(step - 1)) << 1) | (i & (step - 1)), y = x ^ mirror;
            if (y < count) {
                const unsigned long long p = a[x], q = a[y];
                if (p > q) {
                    a[x] = q;
                    a[y] = p;
                }
            }
        }
        __syncthreads();
    }
for (int i = thread; i < count; i += threads) items.data[first + i] = (int)(a[i] & 0xffffffffull);
#else
for (int gap = count / 2; gap > 0; gap = gap == 2 ? 1 : gap * 5 / 11)
    for (int i = gap; i < count; ++i) {
        const unsigned long long key = list[i];
        int place = i;
        for (; place >= gap && list[place - gap] > key; place -= gap) list[place] = list[place - gap];
        list[place] = key;
    }
for (int i = 0; i < count; ++i) items.data[first + i] = (int)(list[i] & 0xffffffffull);
#endif
""")
def sort_list(
    thread: wp.int32, first: wp.int32, count: wp.int32, keys: wp.array[wp.uint64], items: wp.array[wp.int32]
) -> None:
    """Sorts a list and writes its items. All threads of a block (one on the CPU device) must call this function."""
    ...


@wp.kernel(module="unique", enable_backward=False)
def sort_lists(
    threads: wp.int32,
    starts: wp.array[wp.int32],
    segment_starts: wp.array[wp.int32],
    tile_counts: wp.array[wp.int32],
    keys: wp.array[wp.uint64],
    items: wp.array[wp.int32],
    segment_tiles: wp.array[wp.int32],
) -> None:
    """Sorts each list, with one block per tile.

    Args:
        threads: number of threads per block, 1 on the CPU device.
        starts, segment_starts: [tiles + 1] outputs of ``place_lists``.
        tile_counts: [tiles] number of entries in each list, reset to 0.
        keys: [capacity] output of ``fill_lists``. The kernel leaves the keys in an undefined order.
        items: [capacity] output, Gaussian of each entry.
        segment_tiles: [segments] output, tile of each segment.
    """
    tile = wp.tid() // threads
    thread = wp.tid() - tile * threads
    first = starts[tile]
    count = starts[tile + 1] - first
    if thread == 0:
        tile_counts[tile] = 0
    for segment in range(segment_starts[tile] + thread, segment_starts[tile + 1], threads):
        segment_tiles[segment] = tile
    if count > 0:
        sort_list(thread, first, count, keys, items)


@wp.kernel
def mark_blocks(
    side: wp.int32,
    cameras: wp.array[Camera],
    features: wp.array[wp.vec4],
    splats: wp.array[wp.vec4],
    boxes: wp.array[wp.vec4i],
    marks: wp.array2d[wp.int32],
) -> None:
    """Marks the blocks of pixels that the supports of moving Gaussians intersect, with one thread per Gaussian.

    Args:
        side: side length of a block in pixels, which must divide the side length of a tile.
        cameras: [1] camera of the image.
        features: [N] features; Gaussians with a label above 0.5 move.
        splats, boxes: outputs of ``projection.project``.
        marks: [block rows, block columns] output, set to 1 for marked blocks and otherwise unchanged.
    """
    i = wp.tid()
    first = load(splats, 2 * i)
    second = load(splats, 2 * i + 1)
    if second[2] > 0.0 and features[i][3] > 0.5:
        camera = cameras[0]
        box = boxes[i]
        blocks = TILE // side
        for y in range(box[1] * blocks, wp.min(box[3] * blocks, (camera.height + side - 1) // side)):
            top = wp.float32(y * side) + 0.5 - first[1]
            bottom = top + wp.float32(wp.min(side, camera.height - y * side) - 1)
            for x in range(box[0] * blocks, wp.min(box[2] * blocks, (camera.width + side - 1) // side)):
                left = wp.float32(x * side) + 0.5 - first[0]
                right = left + wp.float32(wp.min(side, camera.width - x * side) - 1)
                if least_form(first[2], first[3], second[0], left, right, top, bottom) <= second[2]:
                    marks[y, x] = 1
