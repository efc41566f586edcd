"""The frame log of a scene: the pictures as they came, one record a file, written while they are received.

A file gets its final name at once and is debris until the journal names it; so no frame's bytes are copied or renamed,
a cut can damage one record only, and retention deletes files.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from blake3 import blake3

from client.wire import FileKind, FrameHead
from scas4d_core.npz import sync_folder
from server.facts import Hashes
from server.record_log import CHECKSUM, Kind, Record, opening, read_at

FILE = re.compile(r"(\d{10})-[0-9a-f]{12}\.frame")


class FrameDamage(ValueError):
    """A record of the frame log that cannot be used: says which and why."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """The encoded files of a record, by camera (views, not copies), and the BLAKE3 of each.

    `time` and `part` are what its upload said: seconds, where they were known; whether it holds one camera only.
    """

    index: int
    time: float | None
    part: bool
    images: dict[str, memoryview]
    masks: dict[str, memoryview]
    hashes: Hashes


class Upload:
    """One record on its way to disk. Its bytes are written and hashed as they come; blocking, for a thread.

    Args:
        folder: of the frame log.
        head: says which files follow, and their sizes.
        seconds: time of the frame; None where it is not known yet.
    """

    def __init__(self, folder: Path, head: FrameHead, seconds: float | None) -> None:
        self.name = f"{head.index:010d}-{secrets.token_hex(6)}.frame"
        self.size = 0
        self._folder = folder
        self._file: int | None = os.open(folder / self.name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        files = [file.model_dump(mode="json") for file in head.files]
        said = {"time": seconds, "part": head.part, "files": files}
        start = opening(Kind.PICTURES, head.index, said, sum(file.size for file in head.files))
        self._digest = blake3(start)
        self._write(start)

    def write(self, data: memoryview) -> None:
        """Writes what comes next of the files."""
        self._digest.update(data)
        self._write(data)

    def finish(self) -> None:
        """The record is on disk when this returns.

        Raises:
            OSError: it is not; `abort` removes what is there.
        """
        self._write(self._digest.digest(CHECKSUM))
        assert self._file is not None
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

    def _write(self, data: bytes | memoryview) -> None:
        assert self._file is not None
        view = memoryview(data)
        self.size += len(view)
        while view:
            view = view[os.write(self._file, view) :]


def read_pictures(folder: Path, name: str) -> Pictures:
    """The files of a record, checked.

    Raises:
        FrameDamage: it is gone, cut, or not what was written.
    """
    if not FILE.fullmatch(name):
        raise FrameDamage(f"{name!r} is no name of a record")
    try:
        data = (folder / name).read_bytes()
    except OSError as error:
        raise FrameDamage(f"{name}: {error.strerror}") from None
    found, end = read_at(memoryview(data), 0)
    if not isinstance(found, Record) or found.kind != Kind.PICTURES or end != len(data):
        raise FrameDamage(f"{name}: {'not one record of pictures' if isinstance(found, Record) else found.reason}")
    images: dict[str, memoryview] = {}
    masks: dict[str, memoryview] = {}
    hashes: Hashes = {}
    at = 0
    try:
        for file in found.head["files"]:
            kind, camera = FileKind(file["kind"]), file["camera"]
            piece = found.body[at : at + file["size"]]
            at += file["size"]
            (images if kind == FileKind.IMAGE else masks)[camera] = piece
            hashes.setdefault(camera, {})[kind] = blake3(piece).hexdigest()
        return Pictures(found.index, found.head["time"], bool(found.head["part"]), images, masks, hashes)
    except (KeyError, TypeError, ValueError) as error:
        raise FrameDamage(f"{name}: its head is not one of pictures ({error!r})") from None


def stored(folder: Path) -> dict[str, int]:
    """Bytes of every record's file, by name."""
    return {entry.name: entry.stat().st_size for entry in os.scandir(folder) if FILE.fullmatch(entry.name)}


def remove(folder: Path, names: Iterable[str]) -> None:
    """Deletes records; gone for good when this returns."""
    for name in names:
        (folder / name).unlink(missing_ok=True)
    sync_folder(folder)


def frame_of(name: str) -> int:
    """The frame that a record's file is of."""
    return int(name.partition("-")[0])


def holds(folder: Path, index: int) -> bool:
    """Whether there is a record of the frame."""
    return any(folder.glob(f"{index:010d}-*.frame"))
