"""The cache of compiled kernels: a folder for each version of the kernels' sources.

Numba keeps a compiled function as long as its own file does not change. A kernel also contains functions that it calls
from other files, which Numba does not watch: after an edit there it would continue with the old code. So the folder is
named by a digest of all files here and of the guards, whose values they contain; folders of earlier versions are
removed.

Several processes may fill one folder. Numba replaces files atomically, but two that save different types of one
function at a time would give both the same number, and one would later load the other's code: saving takes a lock.
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
except ImportError:  # not on this system
    fcntl = None  # type: ignore[assignment]

PREFIX = "kernels-"
KEPT = 3
"""Versions kept: several checkouts may share a cache."""


GUARDS = Path(__file__).parent.parent / "guards.py"


def digest(folder: Path = Path(__file__).parent) -> str:
    """Digest of the names and contents of the Python files in and below a folder, and of the guards."""
    hasher = hashlib.sha256()
    for path in [*sorted(folder.rglob("*.py")), GUARDS]:
        name = os.path.relpath(path, folder)
        hasher.update(f"{name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return hasher.hexdigest()[:16]


def base() -> Path:
    """Folder of all versions: NUMBA_CACHE_DIR, else scas4d/numba in the user's folder of caches."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        path = Path(given)
        return path.parent if path.name.startswith(PREFIX) else path  # set by `use` in the process before
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scas4d" / "numba"


def use(folder: Path) -> None:
    """Has Numba cache in this version's folder; where none can be made, Numba's own choice stands."""
    mine = folder / (PREFIX + digest())
    try:
        mine.mkdir(parents=True, exist_ok=True)
        os.utime(mine)
    except OSError:
        return
    # The environment too: Numba reads it anew when it changes, and processes started from here inherit it.
    os.environ["NUMBA_CACHE_DIR"] = str(mine)
    numba.config.CACHE_DIR = str(mine)  # type: ignore[attr-defined]
    remove_old(folder)


def remove_old(folder: Path, kept: int = KEPT) -> None:
    """Removes all versions but the ``kept`` that were used last."""
    with contextlib.suppress(OSError):  # another process may remove the same ones
        versions = sorted(folder.glob(PREFIX + "*"), key=lambda path: path.stat().st_mtime, reverse=True)
        for path in versions[kept:]:
            shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def locked(path: Path, *, wait: bool = True) -> Iterator[bool]:
    """Holds the lock of a file, which is made, as long as this process lives; yields whether it does.

    Where the system or the file system has no such locks, or the file cannot be made, everybody gets the lock.

    Args:
        wait: until the one who holds it lets go; else yields False.
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
    """The index and the data of one function; one process saves at a time."""

    def save(self, key: Any, data: Any) -> None:
        with locked(Path(self._cache_path) / "saving.lock"):
            super().save(key, data)


def shared(dispatcher: Any) -> Any:
    """Has a compiled function's cache filled by one process at a time; returns the function."""
    cache = dispatcher._cache
    if isinstance(cache, FunctionCache):  # it has one
        file = cache._cache_file
        cache._cache_file = _OneAtATime(file._cache_path, cache._impl.filename_base, file._source_stamp)
    return dispatcher
