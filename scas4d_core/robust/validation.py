"""Validation of a state: one that is not finite, bounded and plausible is never committed.

Single Gaussians that are not are held as they were before; where more than a few are, the whole attempt has failed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.update.result import UpdateResult

Array = NDArray[np.float32]

FARTHEST = 1.0
"""Radii of the rig that a Gaussian may move in one update."""
LONGEST = 1.0
"""Radii of the rig that an axis may become long."""
SHRUNK, STRETCHED = 0.1, 10.0
"""Times its length in frame 0 that an axis may become short or long: thousands of updates add up what each leaves, and
the axes would wander without end (docs/stability.md, Time). Such an axis is set to the bound, and counted."""
BRIGHTEST = 8.0
"""Size that a colour may have; 0…1 is what a camera shows, a gain of a camera stretches it."""
FEW = 0.01
"""Share of the moving Gaussians that may be held one by one; more, and the update is not plausible."""


def axis_lengths(gaussians: Gaussians) -> Array:
    """[N, 3] metres."""
    lengths: Array = np.sqrt(np.square(gaussians.factors).sum(axis=1))
    return lengths


def validated(
    before: Gaussians, result: UpdateResult, rows: NDArray[np.int64], radius: float, first: Array | None = None
) -> tuple[UpdateResult, str | None]:
    """Hold what is not finite, bounded and plausible as it was before.

    Args:
        before: Θ_{t−1}. result: of an attempt. rows: [M] the moving. radius: of the rig, metres.
        first: [N, 3] ``axis_lengths`` of frame 0; None: axes may have any length up to ``LONGEST``.

    Returns:
        The result with a state that may be committed, and None; or with ``before``, and the fault of its state.
    """
    after = result.gaussians
    bad = np.zeros(len(after), np.bool_)
    with np.errstate(over="ignore", invalid="ignore"):
        colours = np.abs(after.colours).max(axis=1, initial=0)
        bad |= ~(colours <= BRIGHTEST)  # NaN is not at most anything
        moved = np.square(after.means[rows] - before.means[rows]).sum(axis=1)
        squares = np.square(after.factors[rows]).sum(axis=1)
        lengths = squares.max(axis=1, initial=0)
        turned = np.square(after.rotations[rows]).sum(axis=1)
        fine = (moved <= (FARTHEST * radius) ** 2) & (lengths <= (LONGEST * radius) ** 2) & (np.abs(turned - 1) < 0.01)
        fine &= _oriented(before.factors[rows], after.factors[rows])
    bad[rows] |= ~fine
    count = int(bad.sum())
    if count > max(1, FEW * len(rows)):
        fault = f"{count} of {len(rows)} Gaussians are not finite, or moved or grew too far"
        return replace(result, gaussians=before, held=count), fault
    bounded = 0
    if first is not None:
        after, bounded = _bounded(after, rows, squares, first)
    if count:
        arrays = {name: np.where(_like(bad, now), then, now) for name, then, now in _pairs(before, after)}
        after = after.replace(**arrays)
    return replace(result, gaussians=after, held=count, bounded=bounded), None


def _bounded(after: Gaussians, rows: NDArray[np.int64], squares: Array, first: Array) -> tuple[Gaussians, int]:
    """Axes set to the bounds of their length, and how many were.

    Args:
        squares: [M, 3] of the axes' lengths. first: [N, 3] lengths in frame 0.
    """
    least, most = np.square(SHRUNK * first[rows]), np.square(STRETCHED * first[rows])
    which, axis = np.nonzero((squares < least) | (squares > most))
    if not len(which):
        return after, 0
    there = squares[which, axis]
    bound = np.where(there < least[which, axis], least[which, axis], most[which, axis])
    factors = after.factors.copy()
    factors[rows[which], :, axis] *= np.sqrt(bound / np.maximum(there, np.finfo(np.float32).tiny))[:, None]
    return after.replace(factors=factors), len(which)


def _oriented(before: NDArray[np.float32], after: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[M] whether the map between two factors [M, 3, 3] has not turned the Gaussian inside out."""
    same: NDArray[np.bool_] = ~(np.sign(_det(before)) * np.sign(_det(after)) < 0)
    return same


def _det(factors: NDArray[np.float32]) -> NDArray[np.float32]:
    """[M] of [M, 3, 3]; scaled by nothing, so a sign is all that is read from it."""
    a, b, c = factors[:, 0], factors[:, 1], factors[:, 2]
    det: NDArray[np.float32] = (a * np.cross(b, c)).sum(axis=1)
    return det


def _pairs(before: Gaussians, after: Gaussians) -> list[tuple[str, NDArray[np.float32], NDArray[np.float32]]]:
    return [
        (name, getattr(before, name), getattr(after, name)) for name in ("means", "factors", "rotations", "colours")
    ]


def _like(rows: NDArray[np.bool_], array: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[N, 1, …] for an array [N, …]."""
    return rows.reshape(-1, *[1] * (array.ndim - 1))
