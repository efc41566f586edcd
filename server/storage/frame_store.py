"""Frame log of a scene: the pictures as they were sent, one record a file, written while they are received.

A file gets its final name at once and is debris until the journal names it: no frame's bytes are copied or renamed, a
cut can damage one record only, and retention deletes files.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from client.wire import FileKind, FrameHead
from scas4d_core.storage.npz import sync_folder
from server.storage.events import Hashes
from server.storage.record_log import (
    BY_FILE,
    CHECKSUM,
    LogRecord,
    LogRecordKind,
    checksum,
    opening,
    read_at,
    streamed_record,
)

FILE = re.compile(r"(\d{10})-[0-9a-f]{12}\.frame")
DIRECT = getattr(os, "O_DIRECT", 0)
BLOCK = 4096
"""Bytes: a multiple of what disks write at once."""


class FrameDamage(ValueError):
    """A record of the frame log cannot be used: the message names it and the reason."""


@dataclass(frozen=True, eq=False)
class StoredPictures:
    """The encoded files of a record, by camera (views, not copies), and the BLAKE3 of each.

    `time` in seconds, None where the upload did not know it; `part`: the record holds one camera only.
    """

    index: int
    time: float | None
    part: bool
    images: dict[str, memoryview]
    masks: dict[str, memoryview]
    hashes: Hashes


class Upload:
    """Writes one record while its bytes arrive. All methods block: call them in a thread.

    Writes bypass the page cache where the file system can (O_DIRECT): through it a frame costs ten times the processor
    time. Such writes are of whole blocks, from memory that begins at a page; the remainder waits for the next write.

    Args:
        folder: of the frame log.
        head: names the files that follow, and their sizes.
        seconds: time of the frame; None where it is not known yet.
    """

    def __init__(self, folder: Path, head: FrameHead, seconds: float | None) -> None:
        self.name = f"{head.index:010d}-{secrets.token_hex(6)}.frame"
        self._folder = folder
        self._file: int | None = None
        files = [file.model_dump(mode="json") for file in head.files]
        fields = {"time": seconds, "part": head.part, "files": files}
        length = sum(file.size for file in head.files)
        self._opening = opening(LogRecordKind.PICTURES, head.index, fields, length, BY_FILE)
        self._over = self._opening
        self.begin = len(self._opening)
        """Offset in the file at which the pictures begin."""
        self.size = self.begin + length + CHECKSUM
        """Bytes of the whole record."""

    def write(self, block: memoryview, lead: int) -> None:
        """Writes the next bytes of the files.

        Args:
            block: memory that begins at a page; the bytes are those from `lead` on, and before them is room for the
                remainder of the write before.
            lead: their place in the file, modulo `BLOCK`.
        """
        if self._file is None:
            self._open()
        assert lead == len(self._over)
        block[:lead] = self._over
        whole = len(block) // BLOCK * BLOCK
        self._put(block[:whole])
        self._over = bytes(block[whole:])

    def finish(self, digests: Iterable[bytes]) -> None:
        """Ends and syncs the record, whose files have these BLAKE3s: it is on disk when this returns.

        Raises:
            OSError: it is not on disk; `abort` removes the file.
        """
        if self._file is None:
            self._open()
        assert self._file is not None
        self._direct(False)
        self._put(memoryview(self._over + checksum(self._opening, *digests)))
        os.fsync(self._file)
        os.close(self._file)
        self._file = None
        sync_folder(self._folder)

    def abort(self) -> None:
        """Removes the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        (self._folder / self.name).unlink(missing_ok=True)

    def _open(self) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self._file = os.open(self._folder / self.name, flags, 0o644)
        whole = len(self._over) // BLOCK * BLOCK
        self._put(memoryview(self._over[:whole]))  # of many cameras
        self._over = self._over[whole:]
        self._direct(True)

    def _direct(self, on: bool) -> None:
        assert self._file is not None
        flags = fcntl.fcntl(self._file, fcntl.F_GETFL)
        with contextlib.suppress(OSError):  # not on this file system: through the cache, then
            fcntl.fcntl(self._file, fcntl.F_SETFL, flags | DIRECT if on else flags & ~DIRECT)

    def _put(self, data: memoryview) -> None:
        assert self._file is not None
        while data:
            try:
                data = data[os.write(self._file, data) :]
            except OSError as error:
                # Blocks are larger here, or the write before ended within one, as at the end of the disk.
                if error.errno != errno.EINVAL or not fcntl.fcntl(self._file, fcntl.F_GETFL) & DIRECT:
                    raise
                self._direct(False)


def read_pictures(folder: Path, name: str) -> StoredPictures:
    """Reads the files of a record and checks them.

    Raises:
        FrameDamage: the record is gone, cut, or not as it was written.
    """
    if not FILE.fullmatch(name):
        raise FrameDamage(f"{name!r} is no name of a record")
    try:
        data = (folder / name).read_bytes()
    except OSError as error:
        raise FrameDamage(f"{name}: {error.strerror}") from None
    record, end = read_at(memoryview(data), 0)
    if not isinstance(record, LogRecord) or record.kind != LogRecordKind.PICTURES or end != len(data):
        raise FrameDamage(f"{name}: {'not one record of pictures' if isinstance(record, LogRecord) else record.reason}")
    images: dict[str, memoryview] = {}
    masks: dict[str, memoryview] = {}
    hashes: Hashes = {}
    try:
        for file, piece, digest in zip(record.head["files"], record.files, record.digests, strict=True):
            kind, camera = FileKind(file["kind"]), file["camera"]
            (images if kind == FileKind.IMAGE else masks)[camera] = piece
            hashes.setdefault(camera, {})[kind] = digest.hex()
        return StoredPictures(record.index, record.head["time"], bool(record.head["part"]), images, masks, hashes)
    except (KeyError, TypeError, ValueError) as error:
        raise FrameDamage(f"{name}: its head is not one of pictures ({error!r})") from None


def checked(folder: Path, name: str) -> Iterator[int]:
    """Reads a record again; yields the number of bytes of each piece. At its end all of it has been checked.

    Raises:
        FrameDamage: the record is gone, cut, or not as it was written.
    """
    try:
        with (folder / name).open("rb") as file:
            yield from streamed_record(file)
    except OSError as error:
        raise FrameDamage(f"{name}: {error.strerror}") from None
    except ValueError as error:
        raise FrameDamage(f"{name}: {error}") from None


def stored(folder: Path) -> dict[str, int]:
    """Lists the records of the frame log: bytes by name."""
    return {entry.name: entry.stat().st_size for entry in os.scandir(folder) if FILE.fullmatch(entry.name)}


def remove(folder: Path, names: Iterable[str]) -> None:
    """Deletes records; they are gone for good when this returns."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    sync_folder(folder)


def frame_of(name: str) -> int:
    """Index of the frame that a record belongs to, from its name."""
    return int(name.partition("-")[0])


def holds(folder: Path, index: int) -> bool:
    """True where the frame log has a record of the frame."""
    return any(folder.glob(f"{index:010d}-*.frame"))


class FrameLogIndex:
    """Index of a scene's frame log in memory: bytes of each record by name, and their sums.

    Args:
        folder: of the frame log. sizes: bytes of the records in it, by name.
    """

    def __init__(self, folder: Path, sizes: Mapping[str, int]) -> None:
        self.folder = folder
        self._sizes: dict[str, int] = {}
        self._records: Counter[int] = Counter()
        self.bytes = 0
        for name, size in sizes.items():
            self.add(name, size)

    @property
    def frames(self) -> list[int]:
        """Indices of frames with records, rising."""
        return sorted(self._records)

    def __len__(self) -> int:
        """Number of frames with records."""
        return len(self._records)

    def add(self, name: str, size: int) -> None:
        """Adds a record that is on disk."""
        self._sizes[name] = size
        self._records[frame_of(name)] += 1
        self.bytes += size

    def discard(self, names: Iterable[str]) -> None:
        """Removes records from the index; their files are deleted by `remove`."""
        for name in names:
            if (size := self._sizes.pop(name, None)) is not None:
                index = frame_of(name)
                self._records[index] -= 1
                if not self._records[index]:
                    del self._records[index]
                self.bytes -= size

    def size(self, names: Iterable[str]) -> int:
        """Sums the bytes of records."""
        return sum(self._sizes.get(name, 0) for name in names)
