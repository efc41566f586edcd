"""Compiles the kernels of a scene in separate processes, before the kernels are first called.

Compilation takes tens of seconds and hundreds of megabytes. The calling process would not release
this memory. A process should therefore call `compile_in_processes` before its first
``Reconstruction``. Otherwise, each kernel is compiled in this process on its first call.
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
    """Waits until the kernels of some groups are compiled and in the cache.

    Groups for which this process has already waited are skipped. If all groups are skipped,
    ``then`` has no effect.

    Args:
        wanted: kernel groups to wait for.
        then: kernel groups that are compiled afterwards. The function does not wait for them.
        on_progress: function called with the progress of the compilation.
    """
    asked = tuple(group for group in wanted if group not in _settled)
    if asked:
        _settled.update(asked)
        wait_for_kernels(asked, then, on_progress)


def first_frame_groups(*, points: bool) -> tuple[KernelGroup, ...]:
    """Returns the kernel groups needed for a first frame.

    Args:
        points: whether the user supplies initial points. If not, stereo computes the points.
    """
    return (KernelGroup.FIRST_FRAME,) if points else (KernelGroup.FIRST_FRAME, KernelGroup.STEREO)


def update_groups(covariance: str) -> tuple[KernelGroup, ...]:
    """Returns the kernel groups needed for updates, for a value of ``covariance`` in the settings.

    Args:
        covariance: value of ``UpdateSettings.covariance``.
    """
    return groups_of_update(covariance)


def warm_up(on_progress: OnProgress) -> None:
    """Waits until the kernels of a first frame with initial points are in the cache.

    The kernels of updates with the default covariance are compiled afterwards. The function does
    not wait for them.

    Args:
        on_progress: function called with the progress of the compilation.
    """
    compile_in_processes((KernelGroup.FIRST_FRAME,), then=groups_of_update("entangled"), on_progress=on_progress)


def warm_up_updates() -> None:
    """Waits until the kernels of updates with the default covariance are in the cache."""
    compile_in_processes(groups_of_update("entangled"))
