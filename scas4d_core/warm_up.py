"""Compiles the kernels of a scene in separate processes before they are first called.

Compilation takes tens of seconds, and hundreds of megabytes that the calling process would not release. A process calls
`compile_in_processes` before its first ``Reconstruction``; otherwise kernels are compiled on their first call.
"""

from __future__ import annotations

from collections.abc import Iterable

from scas4d_core.compilation.compile_pool import OnProgress, wait_for_kernels
from scas4d_core.compilation.manifest import KernelGroup, groups_of_update

EVERY = tuple(KernelGroup)

_settled: set[KernelGroup] = set()
"""Kernel groups that this process has already requested."""


def compile_in_processes(
    wanted: Iterable[KernelGroup] = EVERY, *, then: Iterable[KernelGroup] = (), on_progress: OnProgress | None = None
) -> None:
    """Waits until all kernels of the groups ``wanted`` are in the cache; each group is requested once per process.

    Args:
        wanted: kernel groups to wait for.
        then: kernel groups that are compiled afterwards, without waiting for them.
        on_progress: function called with the progress of the compilation.
    """
    asked = tuple(group for group in wanted if group not in _settled)
    if asked:
        _settled.update(asked)
        wait_for_kernels(asked, then, on_progress)


def first_frame_groups(*, points: bool) -> tuple[KernelGroup, ...]:
    """Returns the kernel groups that a first frame needs, with or without initial points."""
    return (KernelGroup.FIRST_FRAME,) if points else (KernelGroup.FIRST_FRAME, KernelGroup.STEREO)


def update_groups(covariance: str) -> tuple[KernelGroup, ...]:
    """Returns the kernel groups that updates need for a ``covariance`` mode of ``UpdateSettings``."""
    return groups_of_update(covariance)


def warm_up(on_progress: OnProgress) -> None:
    """Waits until the kernels of a first frame are in the cache; the kernels of updates are compiled afterwards."""
    compile_in_processes((KernelGroup.FIRST_FRAME,), then=groups_of_update("entangled"), on_progress=on_progress)


def warm_up_updates() -> None:
    """Waits until the kernels of updates are in the cache."""
    compile_in_processes(groups_of_update("entangled"))
