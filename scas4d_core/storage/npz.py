"""npz files that are whole or not there, and read without trusting them. Numpy only.

Each carries a BLAKE2b of 128 bits of every array, over its type, shape and values, in the comment of the zip. The zip's
own CRC-32 does not do: a flipped bit in the header of an array can make numpy read fewer bytes than there are, and then
the CRC is never compared. Files of earlier versions have no comment and are read with the CRC alone.
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
"""What reading a cut or overwritten zip of arrays can raise. zip's checksums cover the arrays; a header that was
overwritten is read before its checksum is, and may ask for an impossible array."""
DIGEST = 16
"""Bytes of a checksum."""
PIECE = 1 << 20
"""Bytes that ``verified`` reads at a time."""


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes an npz that is either whole at ``path`` or not there: temporary file, sync, rename, sync of the folder."""
    with written_whole(path, path.with_name(f".{path.name}.{os.getpid()}.part")) as file:
        _save(file, arrays)


@contextmanager
def written_whole(path: Path, beside: Path) -> Iterator[BinaryIO]:
    """A file to write to that is whole and on disk at ``path`` in the end, or not there; until then at ``beside``."""
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
    """What ``np.savez`` writes, and the checksums."""
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
    return b""  # the CRC is left


def _digest(array: NDArray[Any]) -> str:
    digest = _begun(array.dtype, array.shape)
    digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _agrees(kept: str, found: str) -> bool:
    """Whether a checksum, whole or shortened, is that of what was read."""
    return len(kept) >= 4 and found.startswith(kept)


def _begun(dtype: np.dtype[Any], shape: tuple[int, ...]) -> hashlib.blake2b:
    return hashlib.blake2b(f"{dtype.str} {tuple(shape)}".encode(), digest_size=DIGEST)


def _checksums(archive: zipfile.ZipFile) -> dict[str, str] | None:
    """By array; None in a file of an earlier version."""
    if not archive.comment:
        return None
    found: dict[str, str] = json.loads(archive.comment)["blake2b"]
    names = {name.removesuffix(".npy") for name in archive.namelist()}
    if names != found.keys():
        raise ValueError("its arrays are not those that were written")
    return found


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
    """Named arrays of an npz, or all of them, each compared with its checksum; nothing is unpickled.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it is damaged, or lacks a name; says which file, without its folder, and why.
    """
    try:
        # Opened here, because numpy leaves a damaged file open.
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            checksums = _checksums(file.zip)
            found = {name: np.asarray(file[name]) for name in (file.files if names is None else names)}
            if checksums is not None:
                for name, array in found.items():
                    if not _agrees(checksums[name], _digest(array)):
                        raise ValueError(f"{name} fails its checksum")
            return found
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise _damage(path, error) from error


def verified(path: Path) -> Iterator[int]:
    """Reads all of an npz piece by piece, and yields the bytes of each piece; a whole one is read to the end.

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
                if checksums is not None and not _agrees(checksums[name], digest):
                    raise ValueError(f"{name} fails its checksum")
    except FileNotFoundError:
        raise
    except DAMAGE as error:
        raise _damage(path, error) from error


def verify(path: Path) -> None:
    """Reads all of an npz at once; raises as ``verified``."""
    for _ in verified(path):
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
    digest = _begun(dtype, shape)
    while piece := file.read(PIECE):
        digest.update(piece)
        yield len(piece)
    return digest.hexdigest()


def _damage(path: Path, error: BaseException) -> ValueError:
    return ValueError(f"{path.name} is damaged, or no npz file ({type(error).__name__}: {message_of(error)})")


def clear_parts(folder: Path) -> None:
    """Removes what interrupted writes of ``write_npz`` left; only for the folder's one writer."""
    for part in folder.glob(".*.npz.*.part"):
        part.unlink(missing_ok=True)
