"""Writes npz files atomically, with a checksum for each array, and reads them without trusting them. Numpy only.

The comment of the zip holds a BLAKE2b of 128 bits for every array, over its type, shape and values. The zip's own
CRC-32 is not enough: a flipped bit in the header of an array can make numpy read fewer bytes than there are, and then
the CRC is never compared. A file without these checksums is refused.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scas4d_core.errors import message_of

DAMAGE = (
    OSError, ValueError, KeyError, EOFError, IndexError, TypeError, SyntaxError, TokenError, RuntimeError, MemoryError,
    OverflowError, AttributeError, Warning, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Exceptions that reading a cut or overwritten zip of arrays can raise. An overwritten header is read before the
checksum of its array, and may ask for an impossible array."""
DIGEST = 16
"""Bytes of a checksum."""
PIECE = 1 << 20
"""Bytes that ``iter_verified`` reads at a time."""


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes an npz atomically, whole at ``path`` or not at all: temporary file, sync, rename, sync of the folder.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_npz(Path(folder) / "a.npz", {"means": np.zeros((2, 3))})
    ...     read_npz(Path(folder) / "a.npz")["means"].shape
    (2, 3)
    """
    with open_atomically(path, path.with_name(f".{path.name}.{os.getpid()}.part")) as file:
        _save(file, arrays)


@contextmanager
def open_atomically(path: Path, beside: Path) -> Iterator[BinaryIO]:
    """Opens a file ``beside`` to write to; in the end it is whole and on disk at ``path``, or not there at all."""
    try:
        with beside.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def _save(file: BinaryIO, arrays: Mapping[str, Any]) -> None:
    """Writes the zip as ``np.savez`` does, and the checksums as its comment."""
    checksums = {}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, given in arrays.items():
            array = np.asarray(given)
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
            checksums[name] = _digest(array)
        archive.comment = _comment(checksums)


def _comment(checksums: Mapping[str, str]) -> bytes:
    """The checksums as a zip's comment; shortened where there are so many that they would not fit in it."""
    for length in (2 * DIGEST, 8, 4):
        short = {name: digest[:length] for name, digest in checksums.items()}
        comment = json.dumps({"blake2b": short}, separators=(",", ":")).encode()
        if len(comment) <= zipfile.ZIP_MAX_COMMENT:
            return comment
    raise ValueError(f"{len(checksums)} arrays are too many for one file: their checksums do not fit in its comment")


def _digest(array: NDArray[Any]) -> str:
    digest = _start_checksum(array.dtype, array.shape)
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _checksum_matches(kept: str, found: str) -> bool:
    """True where a stored checksum, whole or shortened, matches the one of the array that was read."""
    return len(kept) >= 4 and found.startswith(kept)


def _start_checksum(dtype: np.dtype[Any], shape: tuple[int, ...]) -> hashlib.blake2b:
    return hashlib.blake2b(f"{dtype.str} {tuple(shape)}".encode(), digest_size=DIGEST)


def _checksums(archive: zipfile.ZipFile) -> dict[str, str]:
    """Checksums by array."""
    if not archive.comment:
        raise ValueError("it has no checksums")
    kept: dict[str, str] = json.loads(archive.comment)["blake2b"]
    names = {name.removesuffix(".npy") for name in archive.namelist()}
    if names != kept.keys():
        raise ValueError("its arrays are not those that were written")
    return kept


def sync_folder(folder: Path) -> None:
    """Syncs a folder: renames and deletions in it survive a power cut."""
    if os.name != "posix":  # elsewhere a directory cannot be opened to be synced
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def member(name: str) -> str:
    """The file of an array in an npz; by its own name numpy finds another where that ends in ".npy"."""
    return f"{name}.npy"


def read_npz(path: Path, names: Sequence[str] | None = None, optional: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """Reads named arrays of an npz, or all, and compares each with its checksum; nothing is unpickled.

    Args:
        optional: arrays that are read as well where the file was written with them.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it is damaged, or lacks a name; says which file, without its folder, and why.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "a.npz"
    ...     write_npz(file, {"a": np.arange(3)})
    ...     shortened = file.write_bytes(file.read_bytes()[:-40])
    ...     read_npz(file)
    Traceback (most recent call last):
    ValueError: a.npz is damaged, or no npz file (...)
    """
    try:
        # Opened here, because numpy leaves a damaged file open.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            checksums = _checksums(file.zip)
            wanted = file.files if names is None else [*names, *(name for name in optional if name in file.files)]
            arrays = {name: np.asarray(file[member(name)]) for name in wanted}
            for name, array in arrays.items():
                if not _checksum_matches(checksums[name], _digest(array)):
                    raise ValueError(f"{name} fails its checksum")
            return arrays
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise _damage(path, error) from error


def iter_verified(path: Path) -> Iterator[int]:
    """Reads all of an npz piece by piece and yields the bytes of each; a damaged file raises on the way.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: as ``read_npz``.
    """
    try:
        with path.open("rb") as opened, zipfile.ZipFile(opened) as archive:
            checksums = _checksums(archive)
            for member in archive.infolist():
                with archive.open(member) as file:
                    digest = yield from _streamed(file)
                name = member.filename.removesuffix(".npy")
                if not _checksum_matches(checksums[name], digest):
                    raise ValueError(f"{name} fails its checksum")
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise _damage(path, error) from error


def verify(path: Path) -> None:
    """Reads all of an npz at once; raises as ``iter_verified``."""
    for _ in iter_verified(path):
        pass


def _streamed(file: IO[bytes]) -> Generator[int, None, str]:
    """Reads one array, whose CRC is compared at its end; returns its checksum."""
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, fortran, dtype = readers[version](file)
    if fortran:  # the checksum is over the other order
        values = file.read()
        yield len(values)
        return _digest(np.frombuffer(values, dtype).reshape(shape, order="F"))
    digest = _start_checksum(dtype, shape)
    while piece := file.read(PIECE):
        digest.update(piece)
        yield len(piece)
    return digest.hexdigest()


def _damage(path: Path, error: BaseException) -> ValueError:
    return ValueError(f"{path.name} is damaged, or no npz file ({type(error).__name__}: {message_of(error)})")


def clear_parts(folder: Path) -> None:
    """Removes temporary files of interrupted ``write_npz`` calls; only for the one process that writes the folder."""
    for part in folder.glob(".*.npz.*.part"):
        part.unlink(missing_ok=True)
