"""Kernel for the visibility of points: the transmittance of the Gaussians in front of a point."""

from __future__ import annotations

from math import exp  # of the C library: its last bit matters only at the threshold of visibility

import numpy as np
from numba import prange

from scas4d_core.kernels.jit import parallel_kernel


@parallel_kernel
def front_transmittance(
    centres, halves, conics, peaks, means, precisions, spreads, lens, uv, front, starts,
    alpha_cap, alpha_floor, reach, least, out,
):  # fmt: skip
    """Writes the product of 1 − α over the Gaussians that absorb a point's ray in front of a given depth.

    As in ``query.ray_depth``, a Gaussian absorbs at the point of the ray that is nearest to its centre in its own
    metric, but at most ``reach`` standard deviations from the centre's depth.

    Args:
        centres, halves: [N, 2] float64 projected means, and half sizes of the bounding boxes, in pixels.
        conics: [N, 2, 2] float64 inverses of the projected covariances.
        peaks: [N] float64 opacities.
        means: [N, 3] float64 means in the camera's axes, in metres.
        precisions: [N, 3, 3] float64 inverses of the covariances in the camera's axes.
        spreads: [N] float64 standard deviations along z, in metres.
        lens: [4] float64 fx, fy, cx, cy in pixels.
        uv: [Q, 2] float64 pixel positions of the points. Neighbouring points share one search for Gaussians.
        front: [Q] float64 depth along z, in metres, in front of which Gaussians count.
        starts: [S + 1] int64 first point of each group of neighbouring points, and Q.
        alpha_cap, alpha_floor: largest alpha, and alpha below which a Gaussian is not blended.
        reach: limit in standard deviations.
        least: transmittance below which a point's product is not completed.
        out: [Q] float64 output.
    """
    for group in prange(len(starts) - 1):
        points = uv[starts[group] : starts[group + 1]]
        low_u, high_u, low_v, high_v = points[0, 0], points[0, 0], points[0, 1], points[0, 1]
        for q in range(len(points)):
            low_u, high_u = min(low_u, points[q, 0]), max(high_u, points[q, 0])
            low_v, high_v = min(low_v, points[q, 1]), max(high_v, points[q, 1])
        near, count = np.empty(len(peaks), np.int32), 0
        for i in range(len(peaks)):
            u, v, half_width, half_height = centres[i, 0], centres[i, 1], halves[i, 0], halves[i, 1]
            if (
                u + half_width >= low_u
                and u - half_width <= high_u
                and v + half_height >= low_v
                and v - half_height <= high_v
            ):
                near[count] = i
                count += 1
        ray, weighted = np.ones(3), np.empty(3)
        for q in range(starts[group], starts[group + 1]):
            transmittance = 1.0
            ray[0], ray[1] = (uv[q, 0] - lens[2]) / lens[0], (uv[q, 1] - lens[3]) / lens[1]
            for i in near[:count]:
                x, y, limit = uv[q, 0] - centres[i, 0], uv[q, 1] - centres[i, 1], reach * spreads[i]
                if abs(x) > halves[i, 0] or abs(y) > halves[i, 1] or means[i, 2] - limit >= front[q]:
                    continue
                power = 0.5 * (conics[i, 0, 0] * x * x + 2 * conics[i, 0, 1] * x * y + conics[i, 1, 1] * y * y)
                alpha = min(alpha_cap, peaks[i] * exp(-power))
                if alpha < alpha_floor:
                    continue
                sharp, along = 0.0, 0.0
                for a in range(3):
                    weighted[a] = (
                        precisions[i, a, 0] * ray[0] + precisions[i, a, 1] * ray[1] + precisions[i, a, 2] * ray[2]
                    )
                    sharp += weighted[a] * ray[a]
                    along += weighted[a] * means[i, a]
                if min(max(along / sharp, means[i, 2] - limit), means[i, 2] + limit) < front[q]:
                    transmittance *= 1 - alpha
                    if transmittance < least:
                        break
            out[q] = transmittance
