"""States at arbitrary video times: the nearest reconstructed state, or an interpolated one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians, quaternions_to_matrices


class Moment(NamedTuple):
    """State at a point in time.

    Attributes:
        frame: index of the nearest frame.
        state: state of this frame, or a state interpolated between two frames.
    """

    frame: int
    state: Gaussians


def moments(
    states: Iterable[tuple[int, float, Gaussians]], wanted: Iterable[float], *, between: bool = False
) -> Iterator[Moment]:
    """Yields the states at the given times, keeping only two input states in memory at a time.

    Args:
        states: (index, time in seconds, state) of each frame, in order.
        wanted: times in seconds in ascending order. Times outside the sequence yield the first or last state.
        between: whether to interpolate states. Otherwise, the nearest state is used, or the earlier one on a tie.

    >>> at = [(k, float(k), Gaussians.of_points([[k, 0, 2]], radius=0.1)) for k in range(3)]
    >>> [moment.frame for moment in moments(at, [0, 0.4, 0.6, 1.5, 9])]
    [0, 0, 1, 1, 2]
    >>> [float(moment.state.means[0, 0]) for moment in moments(at, [0.25, 1.5], between=True)]
    [0.25, 1.5]
    """
    coming = iter(states)
    before = next(coming)
    after = next(coming, None)
    for seconds in wanted:
        while after is not None and after[1] <= seconds:
            before, after = after, next(coming, None)
        share = 0.0 if after is None else max(seconds - before[1], 0.0) / (after[1] - before[1])
        nearest = before if after is None or share <= 0.5 + 1e-6 else after
        if between and after is not None and share > 0:
            yield Moment(nearest[0], interpolate(before[2], after[2], share))
        else:
            yield Moment(nearest[0], nearest[2])


def interpolate(a: Gaussians, b: Gaussians, share: float) -> Gaussians:
    """Returns the state at the fraction ``share`` ([0, 1]) of the way between the states ``a`` and ``b`` of one scene.

    Centres and colours are interpolated linearly. Covariance factors are interpolated in each Gaussian's rotating
    frame, so rotating Gaussians keep their size. Gaussians that are present in only one of the states keep their
    position and fade in or out.

    Args:
        a: earlier state.
        b: later state, whose additional rows are Gaussians born after ``a``.
        share: fraction of the way from ``a`` to ``b``.

    >>> a = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> b = a.concatenate(Gaussians.of_points([[0, 1, 2]], radius=0.1))
    >>> interpolate(a, b, 0.5).opacities
    array([0.9 , 0.45], dtype=float32)
    """
    count = len(a)
    old = b.rows(np.arange(count))
    here, there = a.present, old.present
    part = np.where(here & there, np.float32(share), there.astype(np.float32))
    turn = _slerp(a.rotations, old.rotations, part)
    axes_a = np.swapaxes(quaternions_to_matrices(a.rotations), 1, 2) @ a.factors
    axes_b = np.swapaxes(quaternions_to_matrices(old.rotations), 1, 2) @ old.factors
    fade = np.where(here, 1.0, share) * np.where(there, 1.0, 1 - share)
    mixed = {
        "means": _mix(a.means, old.means, part),
        "factors": quaternions_to_matrices(turn) @ _mix(axes_a, axes_b, part),
        "rotations": turn,
        "colours": _mix(a.colours, old.colours, part),
        "foreground": _mix(a.foreground, old.foreground, part),
        "opacities": (old.own_opacities * fade).astype(np.float32),
    }
    born = b.rows(np.arange(count, len(b)))
    late = {name: getattr(born, name) for name in mixed} | {"opacities": born.opacities * np.float32(share)}
    arrays = {name: np.ascontiguousarray(np.concatenate([mixed[name], late[name]]), np.float32) for name in mixed}
    gone = np.concatenate([~(here | there), born.retired])
    gloss = b.gloss if a.gloss is None or b.gloss is None else _gloss(a.gloss, b.gloss, share)
    environment = b.environment
    if a.environment is not None and b.environment is not None:
        environment = _mix(a.environment, b.environment, np.full(len(a.environment), share, np.float32))
    return Gaussians(**arrays, ids=b.ids, retired=gone, gloss=gloss, environment=environment)


def _mix(a: NDArray[Any], b: NDArray[Any], part: NDArray[Any]) -> NDArray[np.float32]:
    """Interpolates linearly between the rows of two arrays, with the weight ``part`` [N] of each row."""
    ways = part.reshape(-1, *[1] * (a.ndim - 1))
    return np.asarray(a + ways * (b - a), np.float32)


def _slerp(a: NDArray[Any], b: NDArray[Any], part: NDArray[Any]) -> NDArray[np.float32]:
    """Returns unit quaternions [N, 4] interpolated along the shorter arc (normalized linear interpolation)."""
    near = np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b)
    mixed = _mix(a, near, part)
    size = np.linalg.norm(mixed, axis=1, keepdims=True)
    return np.asarray(np.where(size > 1e-6, mixed / np.maximum(size, 1e-6), a), np.float32)


def _gloss(a: NDArray[Any], b: NDArray[Any], share: float) -> NDArray[np.float32]:
    count = min(len(a), len(b))
    mixed = _mix(a[:count], b[:count], np.full(count, share, np.float32))
    return np.concatenate([mixed, b[count:]])
