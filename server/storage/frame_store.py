"""Frame log of a scene: the images as they were uploaded, with one record per file.

A record is written to disk while its bytes are received. The file of a record has its final name
from the start and counts as an orphan until the journal references it. Frames are therefore never
copied or renamed. An interrupted write damages at most one record, and retention deletes whole
files.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import secrets
from bisect import bisect_left, insort
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
    check_record,
    checksum,
    encode_opening,
    read_at,
)

FILE = re.compile(r"(\d{10})-[0-9a-f]{12}\.frame")
DIRECT = getattr(os, "O_DIRECT", 0)
BLOCK = 4096
"""Alignment of direct writes in bytes, a multiple of the sector size of common disks."""


class FrameDamage(ValueError):
    """Raised if a record of the frame log is unusable; the message names the record and the reason."""


@dataclass(frozen=True, eq=False)
class StoredPictures:
    """Encoded image and mask files of a record.

    Attributes:
        index: frame index.
        time: time of the frame in seconds, or None if the upload did not include it.
        part: whether the record is from a single camera.
        images: image file of each camera, as a view of the record.
        masks: mask file of each camera, as a view of the record.
        hashes: BLAKE3 digest of each file, keyed by camera and kind.
    """

    index: int
    time: float | None
    part: bool
    images: dict[str, memoryview]
    masks: dict[str, memoryview]
    hashes: Hashes


class Upload:
    """Writer of one record of the frame log. All methods block, so call them in a thread.

    Writes bypass the page cache (O_DIRECT) if the file system supports it, because cached writes cost ten times the CPU
    time per frame. Direct writes need whole blocks from page-aligned memory; the remainder is kept for the next write.

    Args:
        folder: frame log folder.
        head: names and sizes of the files that follow.
        seconds: time of the frame in seconds, or None if it is not known yet.
    """

    def __init__(self, folder: Path, head: FrameHead, seconds: float | None) -> None:
        self.name = f"{head.index:010d}-{secrets.token_hex(6)}.frame"
        self._folder = folder
        self._file: int | None = None
        files = [file.model_dump(mode="json") for file in head.files]
        fields = {"time": seconds, "single_camera": head.single_camera, "files": files}
        length = sum(file.size for file in head.files)
        self._opening = encode_opening(LogRecordKind.PICTURES, head.index, fields, length, BY_FILE)
        self._over = self._opening
        self.begin = len(self._opening)
        """Offset of the first image in the file, in bytes."""
        self.size = self.begin + length + CHECKSUM
        """Size of the complete record in bytes."""

    def write(self, block: memoryview, lead: int) -> None:
        """Writes the next bytes of the files.

        Args:
            block: page-aligned memory. The new bytes start at `lead`; the remainder of the previous write is copied to
                the space before them.
            lead: file offset of the new bytes, modulo `BLOCK`.
        """
        if self._file is None:
            self._open()
        assert lead == len(self._over)
        block[:lead] = self._over
        whole = len(block) // BLOCK * BLOCK
        self._write_all(block[:whole])
        self._over = bytes(block[whole:])

    def finish(self, digests: Iterable[bytes]) -> None:
        """Completes the record with the BLAKE3 digests of its files and syncs it to disk.

        Raises:
            OSError: the record is not on disk; call `abort` to remove the file.
        """
        if self._file is None:
            self._open()
        assert self._file is not None
        self._direct(False)
        self._write_all(memoryview(self._over + checksum(self._opening, *digests)))
        os.fsync(self._file)
        os.close(self._file)
        self._file = None
        sync_folder(self._folder)

    def abort(self) -> None:
        """Closes and removes the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None
        (self._folder / self.name).unlink(missing_ok=True)

    def _open(self) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC
        self._file = os.open(self._folder / self.name, flags, 0o644)
        whole = len(self._over) // BLOCK * BLOCK
        self._write_all(memoryview(self._over[:whole]))  # the head is long if there are many cameras
        self._over = self._over[whole:]
        self._direct(True)

    def _direct(self, on: bool) -> None:
        assert self._file is not None
        flags = fcntl.fcntl(self._file, fcntl.F_GETFL)
        with contextlib.suppress(OSError):  # this file system lacks O_DIRECT: use the page cache
            fcntl.fcntl(self._file, fcntl.F_SETFL, flags | DIRECT if on else flags & ~DIRECT)

    def _write_all(self, data: memoryview) -> None:
        assert self._file is not None
        while data:
            try:
                data = data[os.write(self._file, data) :]
            except OSError as error:
                # The file system has larger blocks, or a short write (e.g. on a full disk) ended within a block.
                if error.errno != errno.EINVAL or not fcntl.fcntl(self._file, fcntl.F_GETFL) & DIRECT:
                    raise
                self._direct(False)


def read_pictures(folder: Path, name: str) -> StoredPictures:
    """Reads and verifies the files of a record.

    Raises:
        FrameDamage: the record is missing, truncated or corrupt.
    """
    if not FILE.fullmatch(name):
        raise FrameDamage(f"{name!r} is not the name of a record")
    try:
        data = (folder / name).read_bytes()
    except OSError as error:
        raise FrameDamage(f"{name}: {error.strerror}") from None
    record, end = read_at(data, 0)
    if not isinstance(record, LogRecord) or record.kind != LogRecordKind.PICTURES or end != len(data):
        raise FrameDamage(f"{name}: {'not a single image record' if isinstance(record, LogRecord) else record.reason}")
    images: dict[str, memoryview] = {}
    masks: dict[str, memoryview] = {}
    hashes: Hashes = {}
    try:
        for file, piece, digest in zip(record.head["files"], record.files, record.digests, strict=True):
            kind, camera = FileKind(file["kind"]), file["camera"]
            (images if kind == FileKind.IMAGE else masks)[camera] = piece
            hashes.setdefault(camera, {})[kind] = digest.hex()
        return StoredPictures(
            record.index, record.head["time"], bool(record.head["single_camera"]), images, masks, hashes
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FrameDamage(f"{name}: the head does not describe images ({error!r})") from None


def verify_record(folder: Path, name: str) -> Iterator[int]:
    """Verifies a record piece by piece and yields the size of each piece in bytes.

    The record is verified only after the iterator is exhausted.

    Raises:
        FrameDamage: the record is missing, truncated or corrupt.
    """
    try:
        with (folder / name).open("rb") as file:
            yield from check_record(file)
    except OSError as error:
        raise FrameDamage(f"{name}: {error.strerror}") from None
    except ValueError as error:
        raise FrameDamage(f"{name}: {error}") from None


def list_records(folder: Path) -> dict[str, int]:
    """Returns the size in bytes of each record in the frame log, keyed by record name."""
    return {entry.name: entry.stat().st_size for entry in os.scandir(folder) if FILE.fullmatch(entry.name)}


def remove(folder: Path, names: Iterable[str]) -> None:
    """Deletes records and syncs the folder, which makes the deletion durable."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    sync_folder(folder)


def frame_of(name: str) -> int:
    """Returns the index of a record's frame, parsed from the record name."""
    return int(name.partition("-")[0])


def has_record(folder: Path, index: int) -> bool:
    """Returns whether the frame log contains a record of the frame."""
    return any(folder.glob(f"{index:010d}-*.frame"))


class FrameLogIndex:
    """In-memory index of the frame log of a scene, with the size of each record.

    Args:
        folder: frame log folder.
        sizes: size in bytes of each record in the folder, keyed by record name.

    Attributes:
        bytes: total size of all records in bytes.
        frames: indices of frames with records, in ascending order; callers must not modify the list.
    """

    def __init__(self, folder: Path, sizes: Mapping[str, int]) -> None:
        self.folder = folder
        self._sizes = dict(sizes)
        self._records = Counter(map(frame_of, sizes))
        self.frames = sorted(self._records)
        self.bytes = sum(sizes.values())

    def __len__(self) -> int:
        """Returns the number of frames with records."""
        return len(self._records)

    def add(self, name: str, size: int) -> None:
        """Adds a record that is already on disk."""
        self._sizes[name] = size
        index = frame_of(name)
        if index not in self._records:
            insort(self.frames, index)
        self._records[index] += 1
        self.bytes += size

    def discard(self, names: Iterable[str]) -> None:
        """Removes records from the index; call `remove` to delete their files."""
        for name in names:
            if (size := self._sizes.pop(name, None)) is not None:
                index = frame_of(name)
                self._records[index] -= 1
                if not self._records[index]:
                    del self._records[index]
                    del self.frames[bisect_left(self.frames, index)]
                self.bytes -= size

    def size(self, names: Iterable[str]) -> int:
        """Returns the total size of the given records in bytes."""
        return sum(self._sizes.get(name, 0) for name in names)

    def received(self, names: Iterable[str]) -> float:
        """Returns when the newest of the given records was written, in seconds since the epoch; 0 if none exists."""
        newest = 0.0
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                newest = max(newest, (self.folder / name).stat().st_mtime)
        return newest
