"""Has the kernels that a scene needs compiled before they are called, in other processes than the one that computes.

Compiling takes tens of seconds and hundreds of megabytes that a process would keep. A process calls `warm_up_elsewhere`
before its first ``Reconstruction``; without, kernels are compiled where they are first called.
"""

from __future__ import annotations

from collections.abc import Iterable

from scas4d_core.compilation.crew import Told, compiled
from scas4d_core.compilation.manifest import Group, groups_of_update

EVERY = tuple(Group)

_settled: set[Group] = set()
"""The groups that this process has asked for."""


def warm_up_elsewhere(wanted: Iterable[Group] = EVERY, *, then: Iterable[Group] = (), told: Told | None = None) -> None:
    """Waits until the cache has the kernels of the groups ``wanted``; a process asks for each group once.

    Args:
        wanted, then, told: see `compiled`.
    """
    asked = tuple(group for group in wanted if group not in _settled)
    if asked:
        _settled.update(asked)
        compiled(asked, then, told)


def first_frame_groups(*, points: bool) -> tuple[Group, ...]:
    """Returns the groups that a first frame needs; ``points``: whether it is given points to start from."""
    return (Group.FIRST_FRAME,) if points else (Group.FIRST_FRAME, Group.STEREO)


def update_groups(covariance: str) -> tuple[Group, ...]:
    """Returns the groups that updates need; ``covariance`` as in their settings."""
    return groups_of_update(covariance)


def warm_up(told: Told) -> None:
    """Waits until the cache has the kernels of a first frame; those of updates are compiled after them."""
    warm_up_elsewhere((Group.FIRST_FRAME,), then=groups_of_update("entangled"), told=told)


def warm_up_more() -> None:
    """Waits until the cache has the kernels of updates."""
    warm_up_elsewhere(groups_of_update("entangled"))
