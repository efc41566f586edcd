"""An update is a transaction: how often it is tried, in which manner, and what a state must be to be committed.

A state that is not finite, bounded and plausible is never committed. Single Gaussians that are not are held as they
were before; where more than a few are, the whole attempt counts as failed and the next rung of the ladder is tried from
the committed state. Where none holds, the state of the frame before stays, and the frame says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.update.stopping import Pace

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


@dataclass(frozen=True)
class Manner:
    """How an update is tried.

    Attributes:
        name: as the report says it. rates: factor on all of Adam's rates. rigid: clusters turn and shift, nothing else.
        hold_colours: colours stay. cold: without the motion before. longer: factor on the iterations.
    """

    name: str = "as set"
    rates: float = 1.0
    rigid: bool = False
    hold_colours: bool = False
    cold: bool = False
    longer: float = 1.0


AS_SET = Manner()
SMALLER = Manner("smaller steps", rates=0.3, cold=True)
RIGID = Manner("rigid layers only", rates=0.3, rigid=True, hold_colours=True, cold=True)
SOUGHT = Manner("sought again", cold=True, longer=5.0)
"""After ``reacquire``: from where the silhouettes say that the object is, or from where an update ended. Two of three
frames of robot lost, the next is met at 33.5 dB with five times the iterations, at 32.1 dB with twice."""

LADDER = (SMALLER, RIGID)
"""What follows an attempt that is not finite or not plausible."""


@dataclass(frozen=True)
class Course:
    """What an updater is told of one attempt.

    Attributes:
        pace: how long. manner: how. gate: told each camera's first dB once all were rendered, it answers with those
            to leave out from then on; None: all stay. witness: whether start and end are compared (``anytime``).
        enough: errors of the witnesses, by view, at which the frame before needs no iteration; None: never.
        step: seconds since the frame before, where nothing was learnt from that one, see ``Anytime.start``; else None.
    """

    pace: Pace
    manner: Manner = AS_SET
    gate: Callable[[Mapping[str, float]], Mapping[str, str]] | None = None
    witness: bool = False
    enough: Mapping[str, float] | None = None
    step: float | None = None


@dataclass(frozen=True, eq=False)
class Checked:
    """A state that may be committed, or why it may not.

    Attributes:
        gaussians: with what is implausible held. held: how many Gaussians are. fault: None where it may be committed.
        bounded: axes that were set to the shortest or longest that they may be.
    """

    gaussians: Gaussians
    held: int
    fault: str | None
    bounded: int = 0


def axis_lengths(gaussians: Gaussians) -> Array:
    """[N, 3] metres."""
    lengths: Array = np.sqrt(np.square(gaussians.factors).sum(axis=1))
    return lengths


def checked(
    before: Gaussians, after: Gaussians, rows: NDArray[np.int64], radius: float, first: Array | None = None
) -> Checked:
    """Hold what is not finite, bounded and plausible as it was before.

    Args:
        before, after: Θ_{t−1} and what an update makes of it. rows: [M] what moves. radius: of the rig, metres.
        first: [N, 3] ``axis_lengths`` of frame 0; None: axes may have any length up to ``LONGEST``.
    """
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
    bounded = 0
    if first is not None:
        after, bounded = _bounded(after, rows, squares, first)
    if count == 0:
        return Checked(after, 0, None, bounded)
    if count > max(1, FEW * len(rows)):
        return Checked(before, count, f"{count} of {len(rows)} Gaussians are not finite, or moved or grew too far")
    arrays = {name: np.where(_like(bad, now), then, now) for name, then, now in _pairs(before, after)}
    return Checked(after.replace(**arrays), count, None, bounded)


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
