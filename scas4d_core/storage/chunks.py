"""Chunks: compact files in a history's folder, each with a series of older frames. Requires NumPy and zstandard.

``states_<index>.s4d`` starts with the frame of that index. A frame is in a chunk once the record of its state is
complete. The note before the record contains the frame's report. If a frame also has its own file, that file takes
precedence. Exact data is stored elsewhere: ids and opacities with the first frame and births, and retirements in the
logs of later frames.
"""

from __future__ import annotations

import json
import os
import re
import weakref
from array import array
from bisect import bisect_left, bisect_right, insort
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scas4d_core.compact import CompactReader, FileError, FormatError
from scas4d_core.errors import message_of
from scas4d_core.storage.births import Int
from scas4d_core.storage.frame_arrays import EVENTS, Arrays, Stamp
from scas4d_core.storage.npz import open_atomically

REPORT = "report"
"""Key of the report in a frame's note."""
READERS = 2
"""Number of chunks that each process keeps open with a cached state, one for tracks and one for random views."""
_CHUNK_FILE = re.compile(r"states_(\d{6,})\.s4d")


@dataclass(frozen=True)
class Chunk:
    """A compact file in a history's folder.

    Attributes:
        path: path of the file.
        size: size in bytes when the file was last checked.
        changed: modification time in ns when the file was last checked.
        frames: index of each frame, in increasing order.
        times: time of each frame in seconds.
        sizes: size of each frame in the file in bytes.
        checksums: −1 minus the checksum of each state. The negative value distinguishes the stamp (size, checksum)
            of a frame in a chunk from stamps of frame files.
        damage: description of the first damage in the file, or None. Frames after the damage are not listed.
        foreign: whether the file has an unsupported format.
    """

    path: Path
    size: int
    changed: int
    frames: Sequence[int] = ()
    times: Sequence[float] = ()
    sizes: Sequence[int] = ()
    checksums: Sequence[int] = ()
    damage: str | None = None
    foreign: bool = False

    @property
    def first(self) -> int:
        """Index of the first frame, from the file name."""
        return chunk_of(self.path.name) or 0

    def place(self, index: int) -> int | None:
        """Returns the position of a frame in the sequences, or None if the chunk does not contain it."""
        place = bisect_left(self.frames, index)
        return place if place < len(self.frames) and self.frames[place] == index else None


class Chunks:
    """Reader for the chunks in a folder.

    Args:
        directory: folder of the history.

    Attributes:
        known: chunks as of the last ``refresh``, keyed by the index of their first frame.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self.known: dict[int, Chunk] = {}
        self._firsts: list[int] = []
        self._readers: OrderedDict[Path, tuple[Chunk, CompactReader]] = OrderedDict()
        weakref.finalize(self, _close_all, self._readers)

    def refresh(self) -> None:
        """Updates the list of chunks, opening only new or changed ones."""
        firsts = sorted(first for name in os.listdir(self.directory) if (first := chunk_of(name)) is not None)
        known = {first: chunk for first in firsts if (chunk := self._load_chunk(first)) is not None}
        for first in self.known.keys() - known.keys():
            self._close(self.known[first].path)
        self.known, self._firsts = known, list(known)

    def refresh_chunk(self, first: int) -> None:
        """Updates the chunk that starts with frame ``first``, after the chunk was created or extended.

        Of a known chunk, only the new records are read.
        """
        known = self.known.get(first)
        chunk = self._load_chunk(first) if known is None or known.damage is not None else self._extended(known)
        if chunk is not None:
            self.known[first] = chunk
            if first not in self._firsts:
                insort(self._firsts, first)

    def _extended(self, known: Chunk) -> Chunk | None:
        """Returns a known chunk with the records that were appended since, or None if its file was deleted."""
        try:
            status = known.path.stat()
            reader = self._reader(known)
        except FileNotFoundError:
            return None
        reader.refresh()
        chunk = _chunk_of(reader, status)
        self._readers[known.path] = chunk, reader
        return chunk

    def _load_chunk(self, first: int) -> Chunk | None:
        path = self.directory / chunk_file(first)
        try:
            status = path.stat()
        except FileNotFoundError:  # deleted in the meantime
            return None
        known = self.known.get(first)
        if known is not None and (known.size, known.changed) == (status.st_size, status.st_mtime_ns):
            return known
        return _listed(path, status)

    def __contains__(self, index: object) -> bool:
        return isinstance(index, int) and self.of(index) is not None

    def __iter__(self) -> Iterator[int]:
        return (index for first in self._firsts for index in self.known[first].frames)

    def of(self, index: int) -> Chunk | None:
        """Returns the chunk that contains a frame, as of the last refresh, or None."""
        place = bisect_right(self._firsts, index) - 1
        chunk = self.known[self._firsts[place]] if place >= 0 else None
        return chunk if chunk is not None and chunk.place(index) is not None else None

    def stamp(self, index: int) -> Stamp | None:
        """Returns the stamp of a frame, or None if no chunk contains it."""
        if (chunk := self.of(index)) is None or (place := chunk.place(index)) is None:
            return None
        return chunk.sizes[place], chunk.checksums[place]

    def time(self, index: int) -> float | None:
        """Returns the time of a frame in seconds, or None if no chunk contains it."""
        if (chunk := self.of(index)) is None or (place := chunk.place(index)) is None:
            return None
        return chunk.times[place]

    def stamps(self) -> dict[int, Stamp]:
        """Returns the stamps of all frames, in increasing order."""
        chunks = [self.known[first] for first in self._firsts]
        return {
            index: (size, checksum)
            for chunk in chunks
            for index, size, checksum in zip(chunk.frames, chunk.sizes, chunk.checksums, strict=True)
        }

    @property
    def damaged(self) -> list[str]:
        """One sentence for each chunk with frames that cannot be listed because of damage."""
        return [chunk.damage for chunk in self.known.values() if chunk.damage is not None]

    @property
    def foreign(self) -> list[str]:
        """One sentence for each chunk with an unsupported format."""
        return [str(chunk.damage) for chunk in self.known.values() if chunk.foreign]

    def read(self, index: int, names: Sequence[str], optional: Sequence[str] = ()) -> Arrays:
        """Reads arrays of a frame by the names that frame files use.

        Args:
            index: index of the frame.
            names: names of the arrays.
            optional: names of additional arrays to read if present.

        Raises:
            FileNotFoundError: if no chunk contains the frame.
            FileError: if the frame cannot be read, or lacks an array.
        """
        try:
            return self._read(index, names, optional)
        except FileNotFoundError:  # the frame is new, or was deleted
            self.refresh()
            return self._read(index, names, optional)

    def _read(self, index: int, names: Sequence[str], optional: Sequence[str]) -> Arrays:
        if (chunk := self.of(index)) is None:
            raise FileNotFoundError(f"no chunk contains frame {index}")
        with _disk_errors(chunk.path):
            return self._read_from(chunk, index, names, optional)

    def _read_from(self, chunk: Chunk, index: int, names: Sequence[str], optional: Sequence[str]) -> Arrays:
        arrays: Arrays = {}
        asked = {*names, *optional}
        if "time" in asked:
            arrays["time"] = np.asarray(self.time(index), np.float64)
        if asked <= {"time"}:
            return arrays
        reader = self._reader(chunk)
        if "report" in asked:
            text = json.dumps(reader.note(index).get(REPORT, {}))
            arrays["report"] = np.frombuffer(text.encode(), np.uint8)
        if EVENTS in asked and len(log := _log(reader, index)):
            arrays[EVENTS] = log
        if asked - {"time", "report", EVENTS}:
            state = reader.state(index).arrays()
            arrays |= {name: state[name] for name in asked & state.keys()}
        if missing := set(names) - arrays.keys():
            raise FileError(f"{chunk.path.name}: frame {index} lacks {', '.join(sorted(missing))}")
        return arrays

    def reader(self, index: int) -> CompactReader:
        """Returns an open reader for the chunk that contains a frame; callers must not close it.

        Raises:
            FileNotFoundError: if no chunk contains the frame.
            FileError: if the chunk cannot be opened.
        """
        if (chunk := self.of(index)) is None:
            raise FileNotFoundError(f"no chunk contains frame {index}")
        return self._reader(chunk)

    def _reader(self, chunk: Chunk) -> CompactReader:
        known = self._readers.get(chunk.path)
        if known is None or known[0] is not chunk:
            self._close(chunk.path)
            known = self._readers[chunk.path] = chunk, CompactReader(chunk.path)
        self._readers.move_to_end(chunk.path)
        while len(self._readers) > READERS:
            self._readers.popitem(last=False)[1][1].close()
        return known[1]

    def _close(self, path: Path) -> None:
        if (known := self._readers.pop(path, None)) is not None:
            known[1].close()

    def fault(self, index: int) -> str | None:
        """Rereads a frame from disk. Returns the problem found, or None if the frame is intact."""
        if (chunk := self.of(index)) is None:
            return f"frame {index} is missing"
        self._close(chunk.path)
        try:
            self.read(index, ("means", "report"))
        except (FileNotFoundError, FileError) as error:
            return message_of(error)
        return None

    def remove(self, first: int) -> None:
        """Deletes the chunk that starts with frame ``first``."""
        (self.directory / chunk_file(first)).unlink(missing_ok=True)

    def truncate(self, index: int) -> None:
        """Removes a frame and all later ones from the chunk that contains it, together with the chunk's index."""
        if (chunk := self.of(index)) is None:
            return
        self._close(chunk.path)
        if index == chunk.first:
            chunk.path.unlink(missing_ok=True)
        else:
            with CompactReader(chunk.path) as reader:
                end = reader.end_before(index)
            beside = chunk.path.with_name(f".{chunk.path.name}.part")
            # Replace the file instead of truncating it, since it may have hard links (server/storage/fencing.py).
            with chunk.path.open("rb") as old, open_atomically(chunk.path, beside) as file:
                file.write(old.read(end))
        self.refresh()


def _close_all(readers: OrderedDict[Path, tuple[Chunk, CompactReader]]) -> None:
    for _, reader in readers.values():
        reader.close()


def make_note(report: Mapping[str, Any], log: Int, before: int) -> dict[str, Any]:
    """Returns the note of a frame, which contains its report and its events.

    The note of the first frame in a chunk contains the whole log, so no other chunk is needed to read it.

    Args:
        report: report of the frame.
        log: [E, 4] event log up to the frame.
        before: index of the previous frame in the chunk, or −1 for the first one.
    """
    own = log[log[:, 0] > before]
    return {REPORT: dict(report), **({EVENTS: own.tolist()} if len(own) else {})}


def _log(reader: CompactReader, index: int) -> Int:
    """Returns the event log up to a frame."""
    rows = [row for frame in reader.frames if frame <= index for row in reader.note(frame).get(EVENTS, ())]
    return np.array(rows, np.int64).reshape(-1, 4)


def chunk_file(first: int) -> str:
    """Returns the file name of the chunk that starts with frame ``first``.

    >>> chunk_of(chunk_file(121))
    121
    """
    return f"states_{first:06d}.s4d"


def chunk_of(name: str) -> int | None:
    """Returns the index of the first frame of a chunk, given its file name, or None for other files."""
    match = _CHUNK_FILE.fullmatch(name)
    return int(match[1]) if match else None


def _listed(path: Path, status: os.stat_result) -> Chunk:
    """Returns a chunk with the list of its frames, which is empty if the file cannot be opened."""
    try:
        with CompactReader(path) as reader:
            return _chunk_of(reader, status)
    except (FileError, OSError) as error:
        damage, foreign = f"{path.name}: {message_of(error)}", isinstance(error, FormatError)
        return Chunk(path, status.st_size, status.st_mtime_ns, damage=damage, foreign=foreign)


def _chunk_of(reader: CompactReader, status: os.stat_result) -> Chunk:
    """Returns a chunk with the list of its frames; ``status`` is that of the file before it was read."""
    sizes = {index: (taken, -1 - checksum) for index, taken, checksum in reader.sizes()}
    return Chunk(
        reader.path,
        status.st_size,
        status.st_mtime_ns,
        array("q", reader.frames),
        array("d", reader.times.tolist()),
        array("q", [sizes[index][0] for index in reader.frames]),
        array("q", [sizes[index][1] for index in reader.frames]),
        reader.damage,
    )


@contextmanager
def _disk_errors(path: Path) -> Iterator[None]:
    """Converts disk read errors to ``FileError``, which is also raised for damage."""
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        raise FileError(f"{path.name}: {message_of(error)}") from error
