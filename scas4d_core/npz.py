"""npz files that are whole or not there, and read without trusting them. Numpy only."""

from __future__ import annotations

import os
import struct
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

DAMAGE = (
    OSError, ValueError, KeyError, EOFError, IndexError, TypeError, SyntaxError, TokenError, RuntimeError, MemoryError,
    OverflowError, AttributeError, struct.error, zipfile.BadZipFile,
)  # fmt: skip
"""What reading a cut or overwritten zip of arrays can raise. zip's checksums cover the arrays; a header that was
overwritten is read before its checksum is, and may ask for an impossible array."""


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes an npz that is either whole at ``path`` or not there: temporary file, sync, rename, sync of the folder."""
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with beside.open("wb") as file:
            np.savez(file, **dict(arrays))
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """What was renamed or deleted in the folder survives a power cut."""
    if os.name != "posix":  # elsewhere a directory cannot be opened to be synced
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_npz(path: Path, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
    """Named arrays of an npz, or all of them; nothing is unpickled.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it is damaged, or lacks a name; says which file and why.
    """
    try:
        # Opened here, because numpy leaves a damaged file open.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            return {name: np.asarray(file[name]) for name in (file.files if names is None else names)}
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise ValueError(f"{path}: damaged or no npz file ({type(error).__name__}: {error})") from error


def clear_parts(folder: Path) -> None:
    """Removes what interrupted writes of ``write_npz`` left; only for the folder's one writer."""
    for part in folder.glob(".*.npz.*.part"):
        part.unlink(missing_ok=True)
