"""Sources of states for exports: a compact file, its folder, an export, or a scene on the service."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from client.sdk import Client
from scas4d_core.compact import CompactReader, FileHeader
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

if TYPE_CHECKING:
    from scas4d_core.exports.reading import ExportedStates

STATES = "states.s4d"
"""Name of the compact file that `scas4d reconstruct` writes to its output folder."""
MOST = 120
"""Maximum number of frames per request to the service."""
LAST = 1_000_000_000
"""Largest possible frame index."""


@dataclass(frozen=True)
class Source:
    """States of a source, with the default name and folder for exported files.

    Attributes:
        name: default base name of exported files.
        beside: default folder for exported files: the source's folder, or the current folder for a scene.
        of: states of the source.
    """

    name: str
    beside: Path
    of: CompactStates | ExportedStates

    @property
    def head(self) -> FileHeader:
        """World frame, rig, frame rate and background."""
        return self.of.head

    def parts(self) -> NDArray[np.int64] | None:
        """Returns the part label of each Gaussian [N], or None if there are no labels."""
        return self.of.parts()

    def states(self, low: int = 0, high: int = LAST) -> Iterator[tuple[int, float, Gaussians]]:
        """Yields the index, time in seconds and state of each frame from ``low`` to ``high``."""
        return self.of.states(low, high)

    def within(self, low: int, high: int) -> dict[int, float]:
        """Returns the time in seconds of each frame from ``low`` to ``high``, keyed by frame index, in order.

        Raises:
            InputError: if there are no such frames.
        """
        times = {index: time for index, time in zip(self.of.frames, self.of.times, strict=True) if low <= index <= high}
        if not times:
            held = f"frames {self.of.frames[0]} to {self.of.frames[-1]}" if self.of.frames else "no frames"
            asked = f"{low}:{'' if high == LAST else high}"
            raise InputError(f"{self.name} has no frames in the range {asked}", f"it contains {held}")
        return times

    def some(self, indices: Sequence[int]) -> list[Gaussians]:
        """Returns the states of the first, middle and last of the given frames, without duplicates."""
        chosen = dict.fromkeys((indices[0], indices[len(indices) // 2], indices[-1]))
        return [state for index in chosen for _, _, state in self.states(index, index)]

    @property
    def rate(self) -> float:
        """Frame rate in frames per second: the nominal rate if known, else the mean rate, else 30."""
        if self.of.head.frames_per_second is not None:
            return self.of.head.frames_per_second
        length = self.of.times[-1] - self.of.times[0] if self.of.times else 0.0
        return (len(self.of.times) - 1) / length if length > 0 else 30.0


@contextmanager
def opened(
    source: str, low: int, high: int, parts: bool, url: str, token: str | None, rate: float | None = None
) -> Iterator[Source]:
    """Opens a source of states, as a context manager. The states of a scene are downloaded from the service.

    Args:
        source: compact file, output folder of `scas4d reconstruct`, export with Gaussian ids (docs/exports.md), or id
            of a scene on the service.
        low: first frame.
        high: last frame.
        parts: whether to also download the part labels of a scene.
        url: service URL.
        token: access token for the service.
        rate: frame rate of numbered files; None for the default of 30 frames per second.

    Raises:
        InputError: if the source does not exist, or is an export without ids.
    """
    path = Path(source)
    if path.exists():
        yield of_path(path, rate)
    elif not is_scene_id(source):
        raise InputError(
            f"source {source!r} does not exist", "use a compact file, its folder, an export, or a scene id"
        )
    else:
        with of_scene(source, low, high, parts, url, token) as given:
            yield Source(source[:8], Path(), given)


def is_scene_id(source: str) -> bool:
    """Returns whether a source is a scene id: a hexadecimal number that is not an existing path.

    >>> is_scene_id("0f6a21"), is_scene_id("robot"), is_scene_id("out/robot"), is_scene_id("robot.s4d")
    (True, False, False, False)
    """
    return re.fullmatch("[0-9a-f]+", source) is not None and not Path(source).exists()


@dataclass(frozen=True)
class CompactStates:
    """States of one or more consecutive compact files, which are opened one at a time.

    Attributes:
        files: compact files in frame order.
        head: header of the first file.
        frames, times: frame indices and times in seconds of all files.
        damage: description of the damage in the first damaged file, or None.
        remarks: always empty.
    """

    files: Sequence[Path]
    head: FileHeader
    frames: Sequence[int]
    times: Sequence[float]
    damage: str | None
    remarks: Sequence[str] = field(default=())

    @classmethod
    def of(cls, files: Sequence[Path], first: int = 0) -> CompactStates:
        """Returns the states in the files from frame ``first`` onwards. Earlier frames are only used for decoding."""
        heads: list[FileHeader] = []
        times: dict[int, float] = {}
        damages: list[str] = []
        for file in files:
            with CompactReader(file) as reader:
                heads.append(reader.head)
                moments = zip(reader.frames, reader.times.tolist(), strict=True)
                times |= {index: time for index, time in moments if index >= first and index not in times}
                damages += [] if reader.damage is None else [reader.damage]
        return cls(files, heads[0], list(times), list(times.values()), damages[0] if damages else None)

    def parts(self) -> NDArray[np.int64] | None:
        """Returns the part label of each Gaussian [N] from the last file, or None if it contains no labels."""
        with CompactReader(self.files[-1]) as reader:
            return reader.parts()

    def states(self, low: int = 0, high: int = LAST) -> Iterator[tuple[int, float, Gaussians]]:
        """Yields the index, time in seconds and state of each frame from ``low`` to ``high``, without duplicates."""
        last = low - 1
        for file in self.files:
            with CompactReader(file) as reader:
                for index, time in zip(reader.frames, reader.times.tolist(), strict=True):
                    if last < index <= high:
                        last = index
                        yield index, time, reader.state(index)


def of_path(path: Path, rate: float | None = None) -> Source:
    """Returns the source for a compact file, the folder that contains one, or an export.

    Args:
        path: existing file or folder.
        rate: frame rate of numbered files; None for the default of 30 frames per second.

    Raises:
        InputError: if the path is not a supported source.
    """
    if path.is_dir() and (path / STATES).exists():
        path = path / STATES
    if path.suffix.lower() == ".s4d":
        return Source(path.stem, path.parent, CompactStates.of([path]))
    from scas4d_core.exports.reading import open_export  # imported lazily: compact files need none of its readers
    from scas4d_core.exports.reading.sources import DEFAULT_FPS

    return Source(path.stem, path.parent, open_export(path, DEFAULT_FPS if rate is None else rate))


@contextmanager
def of_scene(id: str, low: int, high: int, parts: bool, url: str, token: str | None) -> Iterator[CompactStates]:
    """Yields the states of a scene, downloaded from the service to temporary files.

    Args:
        id: scene id.
        low: first frame.
        high: last frame.
        parts: whether to include part labels.
        url: service URL.
        token: access token for the service.
    """
    with Client(url, token=token, outage=0) as client, TemporaryDirectory() as folder:
        files: list[Path] = []
        following: int | None = low
        while following is not None and following <= high:
            data, following = client.states(id, following, min(MOST, high - following + 1), parts)
            files.append(Path(folder) / f"{len(files)}.s4d")
            files[-1].write_bytes(data)
        yield CompactStates.of(files, low)


def frame_range(text: str | None) -> tuple[int, int]:
    """Parses a frame range such as `2:4` and returns its first and last frame. None means all frames.

    Raises:
        InputError: if the range is invalid or empty.

    >>> frame_range("2:4"), frame_range(":1"), frame_range("7")
    ((2, 4), (0, 1), (7, 7))
    """
    if text is None:
        return 0, LAST
    first, colon, last = text.partition(":")
    try:
        low = int(first or 0)
        high = int(last or LAST) if colon else low
    except ValueError:
        raise InputError(
            f"frames {text!r} is not a valid range", "use A:B, such as 0:99; either end may be omitted"
        ) from None
    if not 0 <= low <= high:
        raise InputError(f"frames {text!r} is an empty range", "use A:B with 0 ≤ A ≤ B")
    return low, high
