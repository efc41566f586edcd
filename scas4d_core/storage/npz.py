"""Writes npz files atomically with a checksum per array, and reads them with verification. Requires only NumPy.

The zip comment contains a 128-bit BLAKE2b digest of the dtype, shape and values of every array. Files without these
checksums are rejected. The CRC-32 of the zip does not suffice, because a flipped bit in an array header can make numpy
read too few bytes. The CRC is then never checked.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from math import prod
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
"""Exceptions that reading a truncated or overwritten zip of arrays can raise.

An overwritten array header is parsed before the checksum is verified, and may describe an impossible array.
"""
DIGEST = 16
"""Size of a checksum in bytes."""
LARGE = 1 << 15
"""Size of an array in bytes from which its checksum is computed by another thread."""
PACKED, PACKED_INDEX = "packed", "packed.index"
"""Names of the arrays of ``pack_arrays``."""
PIECE = 1 << 20
"""Number of bytes that ``iter_verified`` reads at a time."""


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes an npz file atomically, via a temporary file that is synced and renamed.

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
    """Opens the temporary file ``beside`` for writing.

    On success, the file is synced and renamed to ``path``. Otherwise, it is deleted.
    """
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
    """Writes a zip file like ``np.savez``, with the checksums as its comment."""
    values_of = {name: np.asarray(given) for name, given in arrays.items()}
    # A second core hashes while this one writes. Both release the GIL for large arrays.
    with ThreadPoolExecutor(1) as hashing, zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        digests = {name: hashing.submit(_digest, array) for name, array in values_of.items() if array.nbytes >= LARGE}
        for name, array in values_of.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                values = array if array.flags.c_contiguous else array.copy()
                np.lib.format.write_array_header_1_0(member, np.lib.format.header_data_from_array_1_0(values))
                member.write(values.reshape(-1).view(np.uint8).data)  # ``write_array`` would copy the values
        archive.comment = _comment(
            {name: digests[name].result() if name in digests else _digest(array) for name, array in values_of.items()}
        )


def pack_arrays(arrays: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Returns two arrays with the contents of many small ones, which take longer to write.

    >>> unpack_arrays(pack_arrays({"a": np.arange(3), "b": np.array("text")}))
    {'a': array([0, 1, 2]), 'b': array('text', dtype='<U4')}
    """
    values = {name: np.asarray(array) for name, array in arrays.items()}
    index = json.dumps([(name, array.dtype.str, array.shape) for name, array in values.items()])
    packed = b"".join(array.tobytes() for array in values.values())
    return {PACKED_INDEX: np.array(index), PACKED: np.frombuffer(packed, np.uint8)}


def unpack_arrays(packed: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Returns the arrays that ``pack_arrays`` packed.

    Raises:
        KeyError, TypeError, ValueError: if the packed arrays are missing or do not match.
    """
    arrays, at = {}, 0
    for name, dtype, shape in json.loads(str(packed[PACKED_INDEX])):
        count = prod(shape)
        arrays[name] = np.empty(shape, dtype)
        if count:  # ``frombuffer`` refuses empty arrays
            arrays[name][...] = np.frombuffer(packed[PACKED], dtype, count, at).reshape(shape)
        at += arrays[name].nbytes
    return arrays


def _comment(checksums: Mapping[str, str]) -> bytes:
    """Serializes the checksums for the zip comment, and shortens them if they do not fit."""
    for length in (2 * DIGEST, 8, 4):
        short = {name: digest[:length] for name, digest in checksums.items()}
        comment = json.dumps({"blake2b": short}, separators=(",", ":")).encode()
        if len(comment) <= zipfile.ZIP_MAX_COMMENT:
            return comment
    raise ValueError(
        f"too many arrays for one file: the checksums of {len(checksums)} arrays do not fit into the zip comment"
    )


def _digest(array: NDArray[Any]) -> str:
    digest = _start_checksum(array.dtype, array.shape)
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _checksum_matches(kept: str, found: str) -> bool:
    """Returns whether a stored, possibly shortened checksum matches the checksum of the data."""
    return len(kept) >= 4 and found.startswith(kept)


def _start_checksum(dtype: np.dtype[Any], shape: tuple[int, ...]) -> hashlib.blake2b:
    return hashlib.blake2b(f"{dtype.str} {tuple(shape)}".encode(), digest_size=DIGEST)


def _checksums(archive: zipfile.ZipFile) -> dict[str, str]:
    """Returns the stored checksums, keyed by array name."""
    if not archive.comment:
        raise ValueError("the file has no checksums")
    kept: dict[str, str] = json.loads(archive.comment)["blake2b"]
    names = {name.removesuffix(".npy") for name in archive.namelist()}
    if names != kept.keys():
        raise ValueError("the arrays do not match the list of checksums")
    return kept


def sync_folder(folder: Path) -> None:
    """Syncs a folder so that renames and deletions in it survive a power failure."""
    if os.name != "posix":  # other systems cannot open a directory for syncing
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def member(name: str) -> str:
    """Returns the file name of an array in an npz. Array names that end in ".npy" would be ambiguous in numpy."""
    return f"{name}.npy"


def read_npz(path: Path, names: Sequence[str] | None = None, optional: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    """Reads arrays from an npz file and verifies their checksums. Pickled objects are rejected.

    Args:
        path: path of the file.
        names: names of the arrays, or None for all.
        optional: names of additional arrays to read if present.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file is damaged, or an array is missing. The message contains the file name, without its
            folder, and the reason.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "a.npz"
    ...     write_npz(file, {"a": np.arange(3)})
    ...     shortened = file.write_bytes(file.read_bytes()[:-40])
    ...     read_npz(file)
    Traceback (most recent call last):
    ValueError: a.npz is damaged or is not an npz file (...)
    """
    try:
        # Opened here because numpy does not close damaged files.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            checksums = _checksums(file.zip)
            wanted = file.files if names is None else [*names, *(name for name in optional if name in file.files)]
            arrays = {name: np.asarray(file[member(name)]) for name in wanted}
            for name, array in arrays.items():
                if not _checksum_matches(checksums[name], _digest(array)):
                    raise ValueError(f"checksum mismatch in {name}")
            return arrays
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise _damage(path, error) from error


def iter_verified(path: Path) -> Iterator[int]:
    """Verifies a whole npz file piece by piece and yields the size of each piece in bytes.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file is damaged; see ``read_npz``.
    """
    try:
        with path.open("rb") as opened, zipfile.ZipFile(opened) as archive:
            checksums = _checksums(archive)
            for member in archive.infolist():
                with archive.open(member) as file:
                    digest = yield from _streamed(file)
                name = member.filename.removesuffix(".npy")
                if not _checksum_matches(checksums[name], digest):
                    raise ValueError(f"checksum mismatch in {name}")
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise _damage(path, error) from error


def verify(path: Path) -> None:
    """Verifies a whole npz file.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file is damaged; see ``read_npz``.
    """
    for _ in iter_verified(path):
        pass


def _streamed(file: IO[bytes]) -> Generator[int, None, str]:
    """Reads one array in pieces, yields the size of each piece, and returns the checksum of the array.

    The CRC is verified when the end is reached.
    """
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, fortran, dtype = readers[version](file)
    if fortran:  # the checksum is over C order
        values = file.read()
        yield len(values)
        return _digest(np.frombuffer(values, dtype).reshape(shape, order="F"))
    digest = _start_checksum(dtype, shape)
    while piece := file.read(PIECE):
        digest.update(piece)
        yield len(piece)
    return digest.hexdigest()


def _damage(path: Path, error: BaseException) -> ValueError:
    return ValueError(f"{path.name} is damaged or is not an npz file ({type(error).__name__}: {message_of(error)})")


def clear_parts(folder: Path) -> None:
    """Removes temporary files of interrupted ``write_npz`` calls. Only the process that writes may call this."""
    for part in folder.glob(".*.npz.*.part"):
        part.unlink(missing_ok=True)
