"""On-disk cache of compiled kernels, with one folder per version of the kernel sources.

Numba recompiles a cached function only if its own source file changes. Kernels also inline
functions from other files, which Numba does not track. A cached kernel could therefore be outdated
after such a file is edited. The cache folder is named after a digest of all kernel files and of the
guards, whose values are compiled into kernels. Folders of older versions are deleted.

Several processes may write to the same folder. Numba replaces files atomically. However, two
processes that save different signatures of a function at the same time could choose the same file
number. One of the processes would then load the wrong code, so a lock protects saving.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

try:
    import fcntl
except ImportError:  # not available on this system
    fcntl = None  # type: ignore[assignment]

PREFIX = "kernels-"
KEPT = 3
"""Number of versions to keep. Several checkouts may share a cache, so more than one version is
kept."""


GUARDS = Path(__file__).parent.parent / "guards.py"


def digest(folder: Path = Path(__file__).parent) -> str:
    """Returns a digest of all Python files below a folder (names and contents) and of the guards."""
    hasher = hashlib.sha256()
    for path in [*sorted(folder.rglob("*.py")), GUARDS]:
        name = os.path.relpath(path, folder)
        hasher.update(f"{name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return hasher.hexdigest()[:16]


def base() -> Path:
    """Returns the folder that contains all versions of the cache.

    The folder is NUMBA_CACHE_DIR if that is set, and otherwise scas4d/numba in the user's cache
    folder.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        path = Path(given)
        return path.parent if path.name.startswith(PREFIX) else path  # set by `use` in a parent process
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scas4d" / "numba"


def use(folder: Path) -> None:
    """Makes Numba use the cache folder of this version, which is created in ``folder``.

    If the folder cannot be created, Numba uses its default.
    """
    mine = folder / (PREFIX + digest())
    try:
        mine.mkdir(parents=True, exist_ok=True)
        os.utime(mine)
    except OSError:
        return
    # Also set the environment variable, because Numba re-reads it when it changes and child processes inherit it.
    os.environ["NUMBA_CACHE_DIR"] = str(mine)
    numba.config.CACHE_DIR = str(mine)  # type: ignore[attr-defined]
    remove_old(folder)


def remove_old(folder: Path, kept: int = KEPT) -> None:
    """Deletes all versions except the ``kept`` most recently used ones."""
    with contextlib.suppress(OSError):  # another process may delete the same folders
        versions = sorted(folder.glob(PREFIX + "*"), key=lambda path: path.stat().st_mtime, reverse=True)
        for path in versions[kept:]:
            shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Context manager that acquires a file lock, and yields whether the lock was acquired.

    If the system does not support file locks, or the file cannot be created, every caller gets the
    lock.

    Args:
        path: lock file, created if needed.
        wait: whether to wait until the lock is available. If false and the lock is taken, yields False.
    """
    with contextlib.ExitStack() as stack:
        if fcntl is not None:
            try:
                file = stack.enter_context(path.open("w"))
                fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
                return
            except OSError:
                pass
        yield True


class _OneAtATime(IndexDataCacheFile):
    """Cache files of one function, which only one process may write at a time."""

    def save(self, key: Any, data: Any) -> None:
        with locked(Path(self._cache_path) / "saving.lock"):
            super().save(key, data)


def shared(dispatcher: Any) -> Any:
    """Makes concurrent writes to the cache of a compiled function safe.

    Returns:
        The function.
    """
    cache = dispatcher._cache
    if isinstance(cache, FunctionCache):  # caching is enabled
        file = cache._cache_file
        cache._cache_file = _OneAtATime(file._cache_path, cache._impl.filename_base, file._source_stamp)
    return dispatcher
