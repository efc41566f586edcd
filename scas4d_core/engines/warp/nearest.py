"""Nearest neighbours of points, found on the device with the same result as ``scipy.spatial.cKDTree`` on the host.

Points that follow each other along a Morton curve are mostly near each other. The k nearest among these limit the
distance of a point's k nearest neighbours. One query of a bounding volume hierarchy with this distance finds them all.
"""

from __future__ import annotations

import warp as wp
import warp.utils

wp.set_module_options({"enable_backward": False})

FARTHEST = wp.constant(wp.float64(wp.inf))
SLACK = wp.constant(wp.float32(1e-6))
"""Relative enlargement of a query, which exceeds its rounding errors."""
BITS = wp.constant(20)
"""Number of bits per axis of a Morton code, so that cells are small even if a few points are far from all others."""


@wp.kernel
def measure_bounds(points: wp.array[wp.vec3], bounds: wp.array[wp.vec3]) -> None:
    """Extends the bounds [2] (least and greatest coordinates) to the points, with one thread per point."""
    point = points[wp.tid()]
    if wp.max(bounds[0] - point) > 0.0:  # few points reach the atomics, which all share two addresses
        wp.atomic_min(bounds, 0, point)
    if wp.max(point - bounds[1]) > 0.0:
        wp.atomic_max(bounds, 1, point)


@wp.kernel
def find_codes(
    points: wp.array[wp.vec3], bounds: wp.array[wp.vec3], codes: wp.array[wp.int64], order: wp.array[wp.int32]
) -> None:
    """Computes the Morton code of each point within the bounds, with one thread per point.

    Args:
        points: [M] points.
        bounds: [2] output of ``measure_bounds``.
        codes: [M or more] output, Morton codes.
        order: [M or more] output, index of each point.
    """
    i = wp.tid()
    size = bounds[1] - bounds[0]
    cells = wp.float32(1 << BITS) / wp.max(wp.max(size), 1.0e-30)
    code = wp.int64(0)
    for axis in range(3):
        cell = wp.min(wp.int32((points[i][axis] - bounds[0][axis]) * cells), (1 << BITS) - 1)
        for bit in range(BITS):
            code |= wp.int64((cell >> bit) & 1) << wp.int64(3 * bit + axis)
    codes[i] = code
    order[i] = i


@wp.kernel
def sort_points(points: wp.array[wp.vec3], order: wp.array[wp.int32], ordered: wp.array[wp.vec3]) -> None:
    """Gathers the points in the given order, with one thread per point."""
    ordered[wp.tid()] = points[order[wp.tid()]]


@wp.func
def square_between(points: wp.array[wp.vec3], i: wp.int32, j: wp.int32) -> wp.float64:
    """Returns the squared distance of two points. In float64, only exact ties depend on the order of the search."""
    offset = wp.vec3d(points[i]) - wp.vec3d(points[j])
    return wp.dot(offset, offset)


@wp.func
def insert(
    row: wp.int32, other: wp.int32, square: wp.float64, last: wp.int32, index: wp.array2d[wp.int32],
    squares: wp.array2d[wp.float64],
) -> None:  # fmt: skip
    """Inserts a neighbour into a sorted row, and drops the entry at ``last``. The lower index wins a tie."""
    place = last + 1
    while place > 0:
        before = squares[row, place - 1]
        if before < square or (before == square and index[row, place - 1] < other):
            break
        if place <= last:
            squares[row, place] = before
            index[row, place] = index[row, place - 1]
        place -= 1
    if place <= last:
        squares[row, place] = square
        index[row, place] = other


@wp.kernel
def find_nearest(
    tree: wp.uint64,
    points: wp.array[wp.vec3],
    order: wp.array[wp.int32],
    wanted: wp.int32,
    own: wp.int32,
    index: wp.array2d[wp.int32],
    squares: wp.array2d[wp.float64],
) -> None:
    """Finds the nearest neighbours of each point in ascending order, with one thread per point.

    Args:
        tree: id of a ``wp.Bvh`` of the points.
        points: [M] points along a Morton curve.
        order: [M or more] row of each point in the outputs.
        wanted: number of neighbours, less than M.
        own: 1 if a point is its own first neighbour, otherwise 0.
        index: [M, wanted + own or more] output, neighbours of each point as rows.
        squares: [M, wanted + own or more] output, squared distances of the neighbours. They must be infinite.
    """
    place = wp.tid()
    row = order[place]
    count = points.shape[0]
    last = wanted + own - 1
    if own == 1:
        index[row, 0] = row
        squares[row, 0] = wp.float64(-1.0)  # before all others, even if some coincide with the point
    span = wp.min(2 * wanted + 1, count)
    first = wp.clamp(place - wanted, 0, count - span)
    for other in range(first, first + span):
        if other != place:
            insert(row, order[other], square_between(points, place, other), last, index, squares)
    reach = wp.float32(wp.sqrt(squares[row, last]))
    reach += SLACK * (reach + wp.max(wp.abs(points[place])))
    around = wp.vec3(reach, reach, reach)
    query = wp.bvh_query_aabb(tree, points[place] - around, points[place] + around)
    found = wp.int32(0)
    while wp.bvh_query_next(query, found):
        if found < first or found >= first + span:
            insert(row, order[found], square_between(points, place, found), last, index, squares)
    if own == 1:
        squares[row, 0] = wp.float64(0.0)


def nearest(points: wp.array, count: int, own: bool = False) -> tuple[wp.array, wp.array]:
    """Returns the nearest neighbours of each point, without waiting for the device.

    Args:
        points: [M] vec3 finite points, in metres.
        count: number of neighbours k, including the point itself if ``own`` is true.
        own: whether a point is its own first neighbour, or none of its neighbours.

    Returns:
        [M, k] int32 neighbours in ascending order of their distance, and [M, k] float64 squared distances in m². If
        there are fewer than k points, the remaining neighbours are 0 at an infinite distance.
    """
    total, device = len(points), points.device
    index = wp.zeros((total, count), dtype=wp.int32, device=device)
    squares = wp.full((total, count), wp.inf, dtype=wp.float64, device=device)
    wanted = min(count - own, total - 1)
    if wanted <= 0:
        return index, squares
    bounds = wp.array([[wp.inf] * 3, [-wp.inf] * 3], dtype=wp.vec3, device=device)
    codes = wp.empty(2 * total, dtype=wp.int64, device=device)  # the sort needs twice the room
    order = wp.empty(2 * total, dtype=wp.int32, device=device)
    ordered = wp.empty_like(points)
    wp.launch(measure_bounds, total, [points, bounds], device=device)
    wp.launch(find_codes, total, [points, bounds, codes, order], device=device)
    wp.utils.radix_sort_pairs(codes, order, total)
    wp.launch(sort_points, total, [points, order, ordered], device=device)
    tree = wp.Bvh(ordered, ordered)
    inputs = [tree.id, ordered, order, wanted, int(own), index, squares]
    wp.launch(find_nearest, total, inputs, device=device)
    return index, squares
