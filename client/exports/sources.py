"""The states that an export begins from: a compact file, the folder that holds one, an export, or a scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from client.sdk import Client
from scas4d_core.compact import CompactReader, FileHeader
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

STATES = "states.s4d"
"""The compact file that `scas4d reconstruct` leaves in its folder."""
MOST = 120
"""Frames that are asked of the service at once."""
LAST = 1_000_000_000
"""No frame has a higher index."""


class States(Protocol):
    """The states of a sequence, one in memory at a time.

    Attributes:
        head: world, rig, rate and background. frames: indices, rising. times: their seconds.
        damage: why only a part can be read, or None. remarks: what the source lacks, a sentence each.
    """

    @property
    def head(self) -> FileHeader:
        """World, rig, rate and background."""

    @property
    def frames(self) -> Sequence[int]:
        """Indices, rising."""

    @property
    def times(self) -> Sequence[float]:
        """Seconds, of all frames."""

    @property
    def damage(self) -> str | None:
        """Why only a part can be read, or None."""

    @property
    def remarks(self) -> Sequence[str]:
        """Sentences on what the source lacks."""

    def parts(self) -> NDArray[np.int64] | None:
        """[N] part of each Gaussian, or None."""

    def states(self, low: int = 0, high: int = LAST) -> Iterator[tuple[int, float, Gaussians]]:
        """Index, seconds and state of the frames from ``low`` to ``high``."""


@dataclass(frozen=True)
class Source:
    """States with the ``name`` of their outputs and the folder ``beside`` them."""

    name: str
    beside: Path
    of: States

    @property
    def head(self) -> FileHeader:
        """World, rig, rate and background."""
        return self.of.head

    def parts(self) -> NDArray[np.int64] | None:
        """[N] part of each Gaussian, or None."""
        return self.of.parts()

    def states(self, low: int = 0, high: int = LAST) -> Iterator[tuple[int, float, Gaussians]]:
        """Index, seconds and state of the frames from ``low`` to ``high``."""
        return self.of.states(low, high)

    def within(self, low: int, high: int) -> dict[int, float]:
        """Index and time in seconds of the frames from ``low`` to ``high``, in order.

        Raises:
            InputError: there is none.
        """
        times = {index: time for index, time in zip(self.of.frames, self.of.times, strict=True) if low <= index <= high}
        if not times:
            held = f"frames {self.of.frames[0]} to {self.of.frames[-1]}" if self.of.frames else "no frame"
            asked = f"{low}:{'' if high == LAST else high}"
            raise InputError(f"frames {asked} are not in {self.name}", f"it has {held}")
        return times

    def some(self, indices: Sequence[int]) -> list[Gaussians]:
        """The states of the first, the middle and the last of some frames, each once."""
        chosen = dict.fromkeys((indices[0], indices[len(indices) // 2], indices[-1]))
        return [state for index in chosen for _, _, state in self.states(index, index)]

    @property
    def rate(self) -> float:
        """Frames a second: the nominal rate, else the mean one, else 30."""
        if self.of.head.frames_per_second is not None:
            return self.of.head.frames_per_second
        length = self.of.times[-1] - self.of.times[0] if self.of.times else 0.0
        return (len(self.of.times) - 1) / length if length > 0 else 30.0


@contextmanager
def opened(
    source: str, low: int, high: int, parts: bool, url: str, token: str | None, rate: float | None = None
) -> Iterator[Source]:
    """The states of a source; those of a scene are fetched from the service.

    Args:
        source: a compact file, the folder in which `scas4d reconstruct` left one, an export that records which Gaussian
            is which (docs/exports.md), or the id of a scene of the service.
        low, high: first and last frame. parts: with the part of each Gaussian. url, token: of the service.
        rate: frames a second of numbered files.

    Raises:
        InputError: the source is not there, or is an export that lost the ids.
    """
    path = Path(source)
    if path.exists():
        yield of_path(path, rate)
    elif not is_scene_id(source):
        raise InputError(
            f"source {source!r} is not there", "give a compact file, its folder, an export, or a scene's id"
        )
    else:
        with of_scene(source, low, high, parts, url, token) as given:
            yield Source(source[:8], Path(), given)


def is_scene_id(source: str) -> bool:
    """True where a source is the id of a scene: it is no file, and its name could not be one.

    >>> is_scene_id("0f6a21"), is_scene_id("client"), is_scene_id("out/robot"), is_scene_id("robot.s4d")
    (True, False, False, False)
    """
    path = Path(source)
    return not (path.exists() or path.suffix or len(path.parts) > 1)


@dataclass(frozen=True)
class CompactStates:
    """States of one compact file or of several, one after the other; one file is open at a time.

    Attributes:
        files: in the order of their frames. head: of the first. frames, times: of all.
        damage: of the first file that has any.
    """

    files: Sequence[Path]
    head: FileHeader
    frames: Sequence[int]
    times: Sequence[float]
    damage: str | None
    remarks: Sequence[str] = field(default=())

    @classmethod
    def of(cls, files: Sequence[Path], first: int = 0) -> CompactStates:
        """Looks at each file; frames before ``first`` are left out: later frames only depend on them."""
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
        """[N] part of each Gaussian, by the last file."""
        with CompactReader(self.files[-1]) as reader:
            return reader.parts()

    def states(self, low: int = 0, high: int = LAST) -> Iterator[tuple[int, float, Gaussians]]:
        """Index, time in seconds and state of the frames from ``low`` to ``high``, each once."""
        last = low - 1
        for file in self.files:
            with CompactReader(file) as reader:
                for index, time in zip(reader.frames, reader.times.tolist(), strict=True):
                    if last < index <= high:
                        last = index
                        yield index, time, reader.state(index)


def of_path(path: Path, rate: float | None = None) -> Source:
    """The states of a compact file, of the folder that holds one, or of an export.

    Args:
        path: is there. rate: frames a second of numbered files; None: 30.

    Raises:
        InputError: it is none of them.
    """
    if path.is_dir() and (path / STATES).exists():
        path = path / STATES
    if path.suffix.lower() == ".s4d":
        return Source(path.stem, path.parent, CompactStates.of([path]))
    from scas4d_core.exports.reading import open_export  # it brings readers that a compact file does not need
    from scas4d_core.exports.reading.sources import DEFAULT_FPS

    return Source(path.stem, path.parent, open_export(path, DEFAULT_FPS if rate is None else rate))


@contextmanager
def of_scene(id: str, low: int, high: int, parts: bool, url: str, token: str | None) -> Iterator[CompactStates]:
    """The states of a scene, fetched from the service to temporary files.

    Args:
        low, high: first and last frame. parts: with the part of each Gaussian.
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
    """First and last frame of a range.

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
            f"frames {text!r} is not a range", "give A:B, such as 0:99; A: and :B are open at one end"
        ) from None
    if not 0 <= low <= high:
        raise InputError(f"frames {text!r} contains no frame", "give A:B with 0 ≤ A ≤ B")
    return low, high
