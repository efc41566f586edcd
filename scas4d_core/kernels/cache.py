"""The cache of compiled kernels: a folder for each version of the kernels' sources.

Numba keeps a compiled function as long as its own file does not change. A kernel also contains functions that it calls
from other files, which Numba does not watch: after an edit there it would continue with the old code. So the folder is
named by a digest of all files here and of the guards, whose values they contain; folders of earlier versions are
removed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from pathlib import Path

import numba

PREFIX = "kernels-"
KEPT = 3
"""Versions kept: several checkouts may share a cache."""


GUARDS = Path(__file__).parent.parent / "guards.py"


def digest(folder: Path = Path(__file__).parent) -> str:
    """Digest of the names and contents of the Python files in and below a folder, and of the guards."""
    found = hashlib.sha256()
    for path in [*sorted(folder.rglob("*.py")), GUARDS]:
        name = os.path.relpath(path, folder)
        found.update(f"{name}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()[:16]


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
