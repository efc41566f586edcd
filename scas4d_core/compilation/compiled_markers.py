"""The marks of compiled kernels: empty files beside the cache, and the locks of those who compile.

A mark says that a kernel is in the cache for this version, this checkout and this processor. Numba keeps what it
compiled by the path of the source, so a checkout elsewhere has marks of its own. Locks end with the process that holds
them.
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
"""For so long a process tries to get a place: somebody may just look whether it is taken."""


def open_markers() -> CompiledMarkers | None:
    """Returns the marks for this process; None where there is no cache."""
    import numba
    from llvmlite import binding

    from scas4d_core.kernels import jit  # names the cache's folder

    folder = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    where = hashlib.sha256(str(Path(jit.__file__).parent).encode()).hexdigest()[:8]
    named = numba.config.CPU_NAME  # type: ignore[attr-defined]
    target = f"{named}{numba.config.CPU_FEATURES or ''}" if named else binding.get_host_cpu_name()  # type: ignore[attr-defined]
    if not folder:
        return None
    digest = hashlib.sha256(target.encode()).hexdigest()[:8]  # features of a processor make a name too long for a file
    return CompiledMarkers(Path(folder) / f"compiled-{digest}-{where}")


class CompiledMarkers:
    """The marks in a folder, which is made.

    Args:
        folder: of this version, checkout and processor.

    Raises:
        OSError: the folder cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def missing(self, kernels: Iterable[Kernel]) -> list[Kernel]:
        """Returns those of the kernels that have no mark."""
        there = {path.name for path in self.folder.iterdir()}
        return [kernel for kernel in kernels if kernel.key not in there]

    def add(self, kernel: Kernel) -> None:
        """Marks a kernel as compiled."""
        with suppress(OSError):  # for want of room: it is compiled all the same
            (self.folder / kernel.key).touch()

    @contextmanager
    def claim(self, kernel: Kernel) -> Iterator[bool]:
        """Yields True to one process at a time, which may compile the kernel, and False to the others."""
        with locked(self.folder / f"{kernel.key}.lock", wait=False) as mine:
            yield mine

    @contextmanager
    def slot(self, slots: int) -> Iterator[bool]:
        """Yields True to as many processes at a time as there are slots, and False to the others."""
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
        """Returns whether any process has a place."""
        for number in range(slots):
            with locked(self._slot_file(number), wait=False) as mine:
                if not mine:
                    return True
        return False

    def _slot_file(self, number: int) -> Path:
        return self.folder / f"slot-{number}.lock"
