"""Reads, writes and repairs the files in a history's folder. Requires only NumPy.

``fixed.npz``, written once, contains the data that all frames share. ``frame_<index>.npz`` contains a committed frame.
Every file is written under a temporary name, synced and renamed. A file with its final name is therefore complete, and
the directory listing is the only index. All frames depend on ``fixed.npz`` and the first frame, so these files have
copies that are read if the original is damaged or missing.

``born_<index>.npz`` contains the Gaussians born in a frame. This file also has a copy, because all later frames need
it. It is written before its frame, and is kept when the frame is deleted or truncated. Older frames may be in chunks
(``chunks``). A frame's own file takes precedence over its chunk.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scas4d_core.compact import FileError
from scas4d_core.gaussians import FIXED
from scas4d_core.storage.chunks import Chunks
from scas4d_core.storage.faults import UnreadableFrameError, other_format
from scas4d_core.storage.frame_arrays import Arrays, Stamp
from scas4d_core.storage.npz import read_npz, sync_folder, verify, write_npz

FORMAT = 1
"""Format of a folder of states and checkpoints, stored in ``fixed.npz``. Folders with other formats are rejected."""
_FORMAT = "format"
INDEX = "index"
"""Name of the array that stores the frame index in the copy of the first frame."""

FIXED_FILE, FIXED_COPY, FIRST_COPY = "fixed.npz", "fixed.copy.npz", "first.copy.npz"
_CHECKPOINT_FILE = re.compile(r"checkpoint_(\d{6,})\.npz")
_FRAME_FILE = re.compile(r"frame_(\d{6,})\.npz")
_BORN_FILE = re.compile(r"born_(\d{6,})(\.copy)?\.npz")


class FrameFiles:
    """Reader and writer for the files of a history in one directory.

    Attributes:
        chunks: compact files that contain older frames.
        faults: maps the name of each unreadable file to the reason until the fault is reported. A frame in a chunk is
            listed under the name that its own file would have.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.fixed = directory / FIXED_FILE
        self.fixed_copy = directory / FIXED_COPY
        self.first_copy = directory / FIRST_COPY
        self.chunks = Chunks(directory)
        self.faults: dict[str, str] = {}
        self._copied: tuple[Stamp, int] | None = None

    @property
    def exists(self) -> bool:
        """Whether the directory contains a history, possibly with missing files."""
        return self.fixed.exists() or self.fixed_copy.exists()

    def path(self, index: int) -> Path:
        """Returns the path of a frame's file."""
        return self.directory / frame_file(index)

    def list_stamps(self) -> dict[int, Stamp]:
        """Returns the stamps of all frames in increasing order, including the first frame if only its copy exists."""
        stamps: dict[int, Stamp] = {}
        with os.scandir(self.directory) as entries:
            for entry in entries:
                if (index := frame_of(entry.name)) is None:
                    continue
                try:
                    stamps[index] = _stamp(entry.stat())
                except FileNotFoundError:  # deleted or compacted in the meantime
                    continue
        self.chunks.refresh()  # after listing files, because a frame is in a chunk before its file is deleted
        stamps = self.chunks.stamps() | stamps
        first = self._first()
        if stamps and first is not None and first[1] < min(stamps):
            stamps[first[1]] = first[0]
        return dict(sorted(stamps.items()))

    def stamps_of(self, indices: Iterable[int]) -> dict[int, Stamp]:
        """Returns the stamps of the given frames that exist, without listing the directory."""
        stamps: dict[int, Stamp] = {}
        absent: list[int] = []
        for index in sorted(indices):
            try:
                stamps[index] = _stamp(self.path(index).stat())
            except FileNotFoundError:
                first = self._first()
                if first is not None and first[1] == index:
                    stamps[index] = first[0]
                else:
                    absent.append(index)
        if absent:
            self.chunks.refresh()
        stamps |= {index: stamp for index in absent if (stamp := self.chunks.stamp(index)) is not None}
        return dict(sorted(stamps.items()))

    def _first(self) -> tuple[Stamp, int] | None:
        """Returns the stamp and the frame index of the copy of the first frame, or None if it cannot be read."""
        try:
            stamp = _stamp(self.first_copy.stat())
            if self._copied is None or self._copied[0] != stamp:
                self._copied = stamp, int(read_npz(self.first_copy, (INDEX,))[INDEX])
        except (FileNotFoundError, ValueError):
            return None
        return self._copied

    def write(self, index: int, arrays: Mapping[str, Any]) -> Stamp:
        """Writes a frame's file, which commits the frame, and returns the file's stamp."""
        file = self.path(index)
        write_npz(file, arrays)
        return _stamp(file.stat())

    def write_fixed(self, arrays: Arrays, index: int, first: Mapping[str, Any]) -> None:
        """Writes the arrays shared by all frames, a copy of these arrays, and a copy of the first frame.

        Call this before the first frame is committed.

        Args:
            arrays: arrays shared by all frames.
            index: index of the first frame.
            first: arrays of the first frame.
        """
        write_npz(self.fixed, with_format(arrays))
        write_npz(self.fixed_copy, with_format(arrays))
        write_npz(self.first_copy, {**first, INDEX: np.int64(index)})

    def time(self, index: int, stamp: Stamp | None = None) -> float:
        """Returns the time of a frame in seconds.

        Args:
            index: index of the frame.
            stamp: stamp of the frame, or None if unknown. If it is given, no file is read for a frame in a chunk.

        Raises:
            FileNotFoundError: if the frame does not exist.
            UnreadableFrameError: if its file is damaged.
        """
        if stamp is not None and stamp[1] < 0 and (known := self.chunks.time(index)) is not None:
            return known
        return float(self.read(index, ("time",))["time"])

    def read(self, index: int, names: Sequence[str], optional: Sequence[str] = ()) -> Arrays:
        """Reads arrays of a frame from its own file, or else from its chunk or the copy of the first frame.

        Args:
            index: index of the frame.
            names: names of the arrays.
            optional: names of additional arrays to read if present.

        Raises:
            FileNotFoundError: if the frame does not exist.
            UnreadableFrameError: if its file is damaged.
        """
        try:
            return _read(self.path(index), names, optional)
        except (FileNotFoundError, UnreadableFrameError) as error:
            first = self._first()
            if first is None or first[1] != index:
                if isinstance(error, FileNotFoundError):
                    return self._from_chunk(index, names, optional)
                self.faults[self.path(index).name] = str(error)
                if index in self.chunks:  # the file was rewritten or not yet deleted; fall back to the chunk
                    return self._from_chunk(index, names, optional)
                raise
            arrays = _read(self.first_copy, names, optional)
            self.faults[self.path(index).name] = _reason(self.path(index), error)
            return arrays

    def _from_chunk(self, index: int, names: Sequence[str], optional: Sequence[str]) -> Arrays:
        try:
            return self.chunks.read(index, names, optional)
        except FileError as error:
            self.faults[self.path(index).name] = str(error)
            raise UnreadableFrameError(str(error)) from error

    def fault(self, index: int) -> str | None:
        """Verifies all stored data of a frame. Returns the problem found, or None if the frame is intact."""
        if not self.path(index).exists() and index in self.chunks:
            return self.chunks.fault(index)
        return fault_of(self.path(index))

    def require_format(self) -> None:
        """Checks the format of the folder, if a file that specifies it can be read.

        Raises:
            OtherFormatError: if the format is not ``FORMAT``.
        """
        try:
            known = self._either(self.fixed, self.fixed_copy, (), (_FORMAT,))
        except UnreadableFrameError:  # reported later, when the states are read
            return
        written = int(known[_FORMAT]) if _FORMAT in known else None
        if written != FORMAT:
            raise other_format(f"state folder {self.directory.name}", written, FORMAT)

    def read_fixed(self) -> Arrays:
        """Reads the arrays that all frames share.

        Raises:
            UnreadableFrameError: if the file and its copy are damaged or missing.
        """
        return self._either(self.fixed, self.fixed_copy, FIXED)

    def write_born(self, index: int, arrays: Mapping[str, Any]) -> None:
        """Writes the arrays of the Gaussians born in a frame to a file and its copy.

        Call this before the frame is committed.
        """
        write_npz(self.directory / born_file(index), arrays)
        write_npz(self.directory / born_file(index, copy=True), arrays)

    def read_born(self, index: int, names: Sequence[str] | None = None) -> Arrays:
        """Reads the arrays of Gaussians born in a frame: the named arrays, or all arrays if ``names`` is None.

        Raises:
            UnreadableFrameError: if the file and its copy are damaged or missing.
        """
        return self._either(self.directory / born_file(index), self.directory / born_file(index, copy=True), names)

    def births(self) -> list[int]:
        """Returns the frames that have a birth file, committed or not, in increasing order."""
        return sorted({index for name in os.listdir(self.directory) if (index := born_of(name)) is not None})

    def _either(self, path: Path, copy: Path, names: Sequence[str] | None, optional: Sequence[str] = ()) -> Arrays:
        try:
            return _read(path, names, optional)
        except (FileNotFoundError, UnreadableFrameError) as error:
            reason = _reason(path, error)
            self.faults[path.name] = reason
            try:
                return _read(copy, names, optional)
            except FileNotFoundError:
                raise UnreadableFrameError(reason) from error

    def repair_copies(self, first: int, fixed: Arrays, born: Mapping[int, Arrays]) -> dict[str, str]:
        """Rewrites ``fixed.npz``, birth files, the first frame and their copies if they are damaged or missing.

        If the first frame and its copy are damaged, they are left unchanged.

        Args:
            first: index of the first committed frame.
            fixed: arrays that all frames share.
            born: arrays of the births, keyed by frame.

        Returns:
            The problem found in each rewritten file, keyed by file name.
        """
        mended: dict[str, str] = {}
        needed = dict.fromkeys((self.fixed, self.fixed_copy), with_format(fixed))
        for index, arrays in born.items():
            needed |= {self.directory / born_file(index, copy): arrays for copy in (False, True)}
        for file, arrays in needed.items():
            if reason := fault_of(file):
                write_npz(file, arrays)
                mended[file.name] = reason
        own, copy = self.path(first), self.first_copy
        own_fault, copy_fault = fault_of(own), fault_of(copy)
        if copy_fault and not own_fault:
            write_npz(copy, {**read_npz(own), INDEX: np.int64(first)})
            mended[copy.name] = copy_fault
        elif own_fault and not copy_fault:
            arrays = read_npz(copy)
            if int(arrays.pop(INDEX)) == first:
                write_npz(own, arrays)
                mended[own.name] = own_fault
        return mended

    def remove(self, index: int) -> None:
        """Deletes a frame if it exists. If it is in a chunk, all later frames of the chunk are deleted too."""
        self.path(index).unlink(missing_ok=True)
        self.chunks.truncate(index)

    def is_compacted(self, index: int) -> bool:
        """Returns whether a frame is in a chunk and has no file of its own."""
        if self.path(index).exists():
            return False
        if index not in self.chunks:
            self.chunks.refresh()
        return index in self.chunks

    def chunk_of(self, index: int) -> list[int]:
        """Returns all frames of the chunk that contains a frame, or just the frame itself if it is not in a chunk."""
        chunk = self.chunks.of(index)
        return [index] if chunk is None else list(chunk.frames)

    def remove_oldest(self, deleted: Collection[int], left: Container[int]) -> None:
        """Deletes the files of frames, and the chunks that contain no remaining frames.

        Args:
            deleted: indices of the frames to delete.
            left: indices of the remaining frames of the history.
        """
        firsts: set[int] = set()
        for index in deleted:
            self.path(index).unlink(missing_ok=True)
            if (chunk := self.chunks.of(index)) is not None and not any(other in left for other in chunk.frames):
                firsts.add(chunk.first)
        for first in firsts:
            self.chunks.remove(first)
        if firsts:
            self.chunks.refresh()

    def sync(self) -> None:
        """Syncs the directory so that deletions survive a power failure."""
        sync_folder(self.directory)


def with_format(fixed: Arrays) -> Arrays:
    """Returns the arrays of ``fixed.npz``: the arrays shared by all frames, and the format of the folder."""
    return {**fixed, _FORMAT: np.asarray(FORMAT, np.int64)}


def frame_file(index: int) -> str:
    """Returns the name of a frame's file."""
    return f"frame_{index:06d}.npz"


def frame_of(name: str) -> int | None:
    """Returns the index of a frame, given the name of its file, or None for other files."""
    match = _FRAME_FILE.fullmatch(name)
    return int(match[1]) if match else None


def born_file(index: int, copy: bool = False) -> str:
    """Returns the name of a frame's birth file, or of the copy of this file."""
    return f"born_{index:06d}{'.copy' if copy else ''}.npz"


def born_of(name: str) -> int | None:
    """Returns the index of a frame, given the name of its birth file or the copy, or None for other files."""
    match = _BORN_FILE.fullmatch(name)
    return int(match[1]) if match else None


def checkpoint_file(index: int) -> str:
    """Returns the name of a frame's checkpoint file."""
    return f"checkpoint_{index:06d}.npz"


def checkpoint_of(name: str) -> int | None:
    """Returns the index of a frame, given the name of its checkpoint file, or None for other files."""
    match = _CHECKPOINT_FILE.fullmatch(name)
    return int(match[1]) if match else None


def fault_of(file: Path) -> str | None:
    """Verifies a whole file. Returns the problem found, or None if the file is intact."""
    try:
        verify(file)
    except (FileNotFoundError, ValueError) as error:
        return _reason(file, error)
    return None


def _reason(file: Path, error: Exception) -> str:
    return f"{file.name} is missing" if isinstance(error, FileNotFoundError) else str(error)


def _stamp(status: os.stat_result) -> Stamp:
    return status.st_size, status.st_mtime_ns


def _read(path: Path, names: Sequence[str] | None, optional: Sequence[str] = ()) -> Arrays:
    try:
        return read_npz(path, names, optional)
    except ValueError as error:
        raise UnreadableFrameError(str(error)) from error
