"""Births, retirements and revivals of Gaussians: the event log, lifetimes, and roots of newborn Gaussians.

The file of each frame contains the log up to that frame, so the log survives when retention deletes files. Each
birth has its own file, which all later frames need. Requires only NumPy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians, quaternion_products, quaternions_to_matrices

Int = NDArray[np.int64]

COLUMNS = 4
"""Number of columns of the log: frame, kind, first id and last id."""
NO_EVENTS: Int = np.zeros((0, COLUMNS), np.int64)
NO_PARENT = -1
"""Value stored instead of a parent's row for a Gaussian without a parent."""


class Event(IntEnum):
    """Kind of event in the log."""

    BORN = 0
    RETIRED = 1
    REVIVED = 2


@dataclass(frozen=True)
class Life:
    """The lifetime of a Gaussian.

    Attributes:
        id: id of the Gaussian.
        born: frame of its birth; for initial Gaussians, the first frame.
        retired: frames in which the Gaussian was retired, in increasing order. The Gaussian is present from its birth,
            or from a revival, until the next retirement.
        revived: frames in which the Gaussian was revived, in increasing order.
    """

    id: int
    born: int
    retired: tuple[int, ...] = ()
    revived: tuple[int, ...] = ()


def events_of(index: int, kind: Event, rows: NDArray[np.intp], ids: Int) -> Int:
    """Returns the log rows [E, 4] for one kind of event in a frame.

    Gaussians with consecutive rows and ids share one log row.

    Args:
        index: frame of the events.
        kind: kind of the events.
        rows: rows of the affected Gaussians, in increasing order.
        ids: [N] id of the Gaussian in each row.

    >>> events_of(5, Event.RETIRED, np.array([0, 1, 3]), ids=np.array([3, 4, 5, 7])).tolist()
    [[5, 1, 3, 4], [5, 1, 7, 7]]
    """
    if not len(rows):
        return NO_EVENTS
    ids = ids[rows]
    ends = np.flatnonzero((np.diff(ids) != 1) | (np.diff(rows) != 1))
    first, last = ids[np.concatenate([[0], ends + 1])], ids[np.concatenate([ends, [len(ids) - 1]])]
    return np.stack([np.full(len(first), index), np.full(len(first), int(kind)), first, last], axis=1).astype(np.int64)


def births_in(events: Int) -> list[tuple[int, int, int]]:
    """Returns (frame, first id, last id) of each birth in a log, in row order."""
    return [(int(frame), int(first), int(last)) for frame, kind, first, last in events if kind == Event.BORN]


def retired_after(events: Int, ids: Int) -> NDArray[np.bool_]:
    """Returns a mask [N] of the Gaussians that are retired at the end of a log.

    Args:
        events: event log.
        ids: [N] id of the Gaussian in each row. The Gaussians of an event must be in consecutive rows.

    >>> events = np.array([[5, 1, 3, 4], [6, 2, 4, 4]])
    >>> retired_after(events, np.array([2, 3, 4]))
    array([False,  True, False])
    """
    retired = np.zeros(len(ids), np.bool_)
    changes = events[events[:, 1] != Event.BORN]
    if len(changes):
        begins = rows_among(ids, changes[:, 2])
        for (_, kind, first, last), begin in zip(changes.tolist(), begins.tolist(), strict=True):
            retired[begin : begin + last - first + 1] = kind == Event.RETIRED
    return retired


def revived_in(events: Int, index: int, ids: Int) -> Int:
    """Returns the rows of the Gaussians that were revived in a frame.

    Args:
        events: event log.
        index: index of the frame.
        ids: [N] id of the Gaussian in each row.

    >>> revived_in(np.array([[5, 1, 3, 4], [6, 2, 4, 4]]), 6, np.array([2, 3, 4]))
    array([2])
    """
    own = events[(events[:, 0] == index) & (events[:, 1] == Event.REVIVED)].tolist()
    wanted = [np.arange(first, last + 1) for _, _, first, last in own]
    return rows_among(ids, np.concatenate(wanted)) if wanted else np.zeros(0, np.int64)


def rows_among(ids: Int, wanted: Int) -> Int:
    """Returns the row of each wanted id [Q], or −1 for unknown ids.

    >>> rows_among(np.array([7, 3, 5]), np.array([5, 4, 7]))
    array([ 2, -1,  0])
    """
    if not len(ids):
        return np.full(len(wanted), -1, np.int64)
    order = np.argsort(ids, kind="stable")
    place = order[np.minimum(np.searchsorted(ids, wanted, sorter=order), len(ids) - 1)]
    return np.where(ids[place] == wanted, place, -1).astype(np.int64)


def lives_of(events: Int, wanted: Iterable[int], first: int) -> list[Life]:
    """Returns the lifetimes of Gaussians as recorded in a log.

    Args:
        events: event log.
        wanted: ids of the Gaussians.
        first: first frame, in which Gaussians without a birth event were born.
    """
    lives = []
    for id in wanted:
        own = events[(events[:, 2] <= id) & (id <= events[:, 3])]
        born, retired, revived = (tuple(own[own[:, 1] == kind, 0].tolist()) for kind in Event)
        lives.append(Life(int(id), born[0] if born else first, retired, revived))
    return lives


def extend_roots(roots: Gaussians, state: Gaussians, parents: Int | None) -> Gaussians:
    """Returns the roots of a state: Θ_0, plus newborn Gaussians at the positions that they would have had in frame 0.

    Clusters and neighbours are computed from the roots. A newborn Gaussian is moved back by the inverse rigid motion of
    its parent. A Gaussian without a parent keeps its position at birth.

    Args:
        roots: [N] roots before this frame.
        state: [N + B] state after this frame.
        parents: [B] row of each newborn Gaussian's parent, or None if no newborn Gaussian has a parent.
    """
    count, born = len(roots), state.rows(np.arange(len(roots), len(state)))
    if len(born):
        parent_rows = np.full(len(born), NO_PARENT, np.int64) if parents is None else parents
        means, factors, rotations = (
            getattr(born, name).astype(np.float64) for name in ("means", "factors", "rotations")
        )
        which = np.flatnonzero(parent_rows != NO_PARENT)
        rows = parent_rows[which]
        back = quaternion_products(
            roots.rotations[rows].astype(np.float64), _inverse(state.rotations[rows].astype(np.float64))
        )
        turn = quaternions_to_matrices(back)
        means[which] = roots.means[rows] + _turned(turn, means[which] - state.means[rows])
        factors[which] = turn @ factors[which]
        rotations[which] = quaternion_products(back, rotations[which])
        roots = roots.concatenate(
            born.replace(
                means=means.astype(np.float32),
                factors=factors.astype(np.float32),
                rotations=rotations.astype(np.float32),
            )
        )
        assert len(roots) == count + len(born)
    return roots.replace(retired=state.retired.copy())


def _turned(turns: NDArray[Any], vectors: NDArray[Any]) -> NDArray[Any]:
    turned: NDArray[Any] = (turns @ vectors[:, :, None])[:, :, 0]
    return turned


def _inverse(quaternions: NDArray[Any]) -> NDArray[Any]:
    conjugates: NDArray[Any] = quaternions * np.array([1, -1, -1, -1])
    return conjugates
