"""Markers for compiled kernels, and lock files of the processes that compile kernels.

A marker is an empty file in the cache folder. It means that a kernel is cached for this version,
checkout and processor. Numba keys its cache by source path, so each checkout has its own markers. A
lock is released when its process ends.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scas4d_core.compilation.manifest import Kernel
from scas4d_core.kernels.cache import locked

SLOT_WAIT_S = 1.0
"""Seconds for which a process keeps trying to get a slot. The first attempt may fail, because
`is_compiling` briefly locks slots to check them."""


def open_markers() -> CompiledMarkers | None:
    """Returns the markers for this process, or None if there is no cache."""
    import numba
    from llvmlite import binding

    from scas4d_core.kernels import jit  # sets the cache folder

    folder = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    where = hashlib.sha256(str(Path(jit.__file__).parent).encode()).hexdigest()[:8]
    named = numba.config.CPU_NAME  # type: ignore[attr-defined]
    target = f"{named}{numba.config.CPU_FEATURES or ''}" if named else binding.get_host_cpu_name()  # type: ignore[attr-defined]
    if not folder:
        return None
    digest = hashlib.sha256(target.encode()).hexdigest()[:8]  # the feature list is too long for a file name
    return CompiledMarkers(Path(folder) / f"compiled-{digest}-{where}")


class CompiledMarkers:
    """Markers for compiled kernels, stored in a folder.

    Args:
        folder: folder for this version, checkout and processor; created if it does not exist.

    Raises:
        OSError: if the folder cannot be created.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def missing(self, kernels: Iterable[Kernel]) -> list[Kernel]:
        """Returns the kernels that have no marker."""
        there = {path.name for path in self.folder.iterdir()}
        return [kernel for kernel in kernels if kernel.key not in there]

    def add(self, kernel: Kernel) -> None:
        """Marks a kernel as compiled."""
        with suppress(OSError):  # e.g. the disk is full; the compiled kernel can be used anyway
            (self.folder / kernel.key).touch()

    @contextmanager
    def claim(self, kernel: Kernel) -> Iterator[bool]:
        """Context manager that lets one process at a time compile a kernel.

        Yields True if this process may compile the kernel, and False if another process does so.
        """
        with locked(self.folder / f"{kernel.key}.lock", wait=False) as mine:
            yield mine

    @contextmanager
    def slot(self, slots: int) -> Iterator[bool]:
        """Context manager that lets at most ``slots`` processes compile at a time.

        Yields True if this process has a slot, and False if no slot becomes free within
        ``SLOT_WAIT_S``.
        """
        until = time.monotonic() + SLOT_WAIT_S
        while True:
            for number in range(slots):
                with locked(self._slot_file(number), wait=False) as mine:
                    if mine:
                        yield True
                        return
            if time.monotonic() > until:
                yield False
                return
            time.sleep(0.05)

    def is_compiling(self, slots: int) -> bool:
        """Returns whether any process holds a slot."""
        for number in range(slots):
            with locked(self._slot_file(number), wait=False) as mine:
                if not mine:
                    return True
        return False

    def _slot_file(self, number: int) -> Path:
        return self.folder / f"slot-{number}.lock"
