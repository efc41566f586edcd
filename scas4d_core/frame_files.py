"""The files of a history: ``fixed.npz``, written once, and one ``frame_<index>.npz`` a committed frame. Numpy only.

Every file is written beside its place, synced and renamed: a file with its final name is whole, and the listing of the
directory is the only index there is.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from scas4d_core.npz import read_npz, sync_folder, write_npz

Arrays = dict[str, NDArray[Any]]
Stamp = tuple[int, int]
"""Bytes and time of change of a file, in ns: whether it is the one that was read."""

_FRAME_FILE = re.compile(r"frame_(\d{6,})\.npz")


class HistoryError(ValueError):
    """A history that cannot be extended or read: the message names the frame or file, the fault and the remedy."""


class UnreadableFrameError(HistoryError):
    """A frame that is not in the history, or whose file is damaged."""


class FrameFiles:
    """The files in one directory."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.fixed = directory / "fixed.npz"

    def path(self, index: int) -> Path:
        """The file of a frame."""
        return self.directory / f"frame_{index:06d}.npz"

    def listed(self) -> dict[int, Stamp]:
        """The frames in the directory, rising."""
        found: dict[int, Stamp] = {}
        with os.scandir(self.directory) as entries:
            for entry in entries:
                if match := _FRAME_FILE.fullmatch(entry.name):
                    try:
                        found[int(match[1])] = _stamp(entry.stat())
                    except FileNotFoundError:  # deleted meanwhile
                        continue
        return dict(sorted(found.items()))

    def stamped(self, indices: Iterable[int]) -> dict[int, Stamp]:
        """The same of some frames, without looking at the others."""
        found: dict[int, Stamp] = {}
        for index in sorted(indices):
            with contextlib.suppress(FileNotFoundError):
                found[index] = _stamp(self.path(index).stat())
        return found

    def write(self, index: int, arrays: Mapping[str, Any]) -> Stamp:
        """Commits a frame."""
        file = self.path(index)
        write_npz(file, arrays)
        return _stamp(file.stat())

    def write_fixed(self, arrays: Arrays) -> None:
        """Writes what all frames need; before the first of them."""
        write_npz(self.fixed, arrays)

    def time(self, index: int) -> float:
        """Seconds of a frame.

        Raises:
            FileNotFoundError: it is not there. ValueError: it is damaged.
        """
        return float(read_npz(self.path(index), ("time",))["time"])

    def read(self, index: int, names: Sequence[str]) -> Arrays:
        """Named arrays of a frame.

        Raises:
            FileNotFoundError: it is not there. UnreadableFrameError: it is damaged.
        """
        return _read(self.path(index), names)

    def read_fixed(self, names: Sequence[str]) -> Arrays:
        """Named arrays of what all frames need.

        Raises:
            FileNotFoundError: it is not there. UnreadableFrameError: it is damaged.
        """
        return _read(self.fixed, names)

    def remove(self, index: int) -> None:
        """Deletes a frame, if it is there."""
        self.path(index).unlink(missing_ok=True)

    def sync(self) -> None:
        """What was deleted stays so after a power cut."""
        sync_folder(self.directory)


def _stamp(status: os.stat_result) -> Stamp:
    return status.st_size, status.st_mtime_ns


def _read(path: Path, names: Sequence[str]) -> Arrays:
    try:
        return read_npz(path, names)
    except ValueError as error:
        raise UnreadableFrameError(f"{error}; restore it or start the scene anew") from error
