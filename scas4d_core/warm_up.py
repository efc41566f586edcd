"""Has the kernels that a scene needs compiled before they are called, in other processes than the one that computes.

Compiling takes tens of seconds and hundreds of megabytes that a process would keep. A process calls
`compile_in_processes`
before its first ``Reconstruction``; without, kernels are compiled where they are first called.
"""

from __future__ import annotations

from collections.abc import Iterable

from scas4d_core.compilation.compile_pool import OnProgress, wait_for_kernels
from scas4d_core.compilation.manifest import KernelGroup, groups_of_update

EVERY = tuple(KernelGroup)

_settled: set[KernelGroup] = set()
"""The groups that this process has asked for."""


def compile_in_processes(
    wanted: Iterable[KernelGroup] = EVERY, *, then: Iterable[KernelGroup] = (), on_progress: OnProgress | None = None
) -> None:
    """Waits until the cache has the kernels of the groups ``wanted``; a process asks for each group once.

    Args:
        wanted, then, on_progress: see `compiled`.
    """
    asked = tuple(group for group in wanted if group not in _settled)
    if asked:
        _settled.update(asked)
        wait_for_kernels(asked, then, on_progress)


def first_frame_groups(*, points: bool) -> tuple[KernelGroup, ...]:
    """Returns the groups that a first frame needs; ``points``: whether it is given points to start from."""
    return (KernelGroup.FIRST_FRAME,) if points else (KernelGroup.FIRST_FRAME, KernelGroup.STEREO)


def update_groups(covariance: str) -> tuple[KernelGroup, ...]:
    """Returns the groups that updates need; ``covariance`` as in their settings."""
    return groups_of_update(covariance)


def warm_up(on_progress: OnProgress) -> None:
    """Waits until the cache has the kernels of a first frame; those of updates are compiled after them."""
    compile_in_processes((KernelGroup.FIRST_FRAME,), then=groups_of_update("entangled"), on_progress=on_progress)


def warm_up_updates() -> None:
    """Waits until the cache has the kernels of updates."""
    compile_in_processes(groups_of_update("entangled"))
