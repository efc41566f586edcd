"""`scas4d export`: states of a compact file, or of a scene of the service, in the formats of other tools."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from client.cli.progress import Bars, console
from client.sdk import Client
from scas4d_core.compact import CompactReader, Head
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

STATES = "states.s4d"
"""The compact file that `scas4d reconstruct` leaves in its folder."""
MOST = 120
"""Frames that are asked of the service at once."""
LAST = 1_000_000_000
"""No frame has a higher index."""


def export(
    source: str,
    format: str,
    out: Path | None,
    frames: str | None = None,
    ids: list[int] | None = None,
    *,
    url: str,
    token: str | None,
) -> None:
    """Exports frames; one state is in memory at a time.

    Args:
        source: a compact file, the folder in which `scas4d reconstruct` left one, or the id of a scene of the service.
        format: a name of docs/exports.md. out: a folder or `.zip` for numbered files, else a file; None: beside the
            file, or in this folder for a scene, named after it and the format.
        frames: `A:B`, the frames from A to B, both counted in; either may be left out. None: all. ids: of tracks.
        url, token: of the service.

    Raises:
        InputError: a format, a range or an output that cannot be.
    """
    from scas4d_core.exports.formats import check_suffix, format_of
    from scas4d_core.exports.sequence import export_sequence

    wanted = format_of(format)
    low, high = frame_range(frames)
    if ids and format != "tracks":
        raise InputError(f"id is given for format {format!r}", "leave --id out; it chooses the Gaussians of tracks")
    if out is not None and not wanted.numbered:
        check_suffix(out, wanted)
    with_parts = wanted.needs_parts or format == "usd"
    path = Path(source)
    with ExitStack() as opened, Bars() as bars:
        if path.exists():
            given = of_file(path / STATES if path.is_dir() else path)
        elif path.suffix or len(path.parts) > 1:
            raise InputError(f"source {source!r} is not there", "give a compact file, its folder, or a scene's id")
        else:
            given = opened.enter_context(of_scene(source, low, high, with_parts, url, token))
        target = out or given.beside / f"{given.name}-{format}{'' if wanted.numbered else wanted.suffixes[0]}"
        if given.damage is not None:
            console.print(f"only a part can be read: {given.damage}", soft_wrap=True)
        count = sum(low <= index <= high for index in given.frames)
        if not count:
            held = f"frames {given.frames[0]} to {given.frames[-1]}" if given.frames else "no frame"
            raise InputError(f"frames {frames or 'of all'} are not in {source}", f"it has {held}")
        paths = export_sequence(
            given.states(low, high),
            format,
            target,
            world=given.head.world,
            rig=given.head.rig,
            parts=given.parts() if with_parts else None,
            ids=ids,
            frames_per_second=given.head.frames_per_second,
            progress=lambda index, done: bars("exporting", done, count),
        )
    what = f"{len(paths)} files in {target}" if len(paths) > 1 else f"{count} frames in {target}"
    console.print(f"{what} ({format}; docs/exports.md says what each format holds)", soft_wrap=True)


@dataclass(frozen=True)
class CompactStates:
    """States of one compact file or of several, one after the other; one file is open at a time.

    Attributes:
        name, beside: of outputs. files: in the order of their frames. head: of the first. frames: of all.
        damage: of the first file that has any.
    """

    name: str
    beside: Path
    files: Sequence[Path]
    head: Head
    frames: Sequence[int]
    damage: str | None

    @classmethod
    def of(cls, name: str, beside: Path, files: Sequence[Path]) -> CompactStates:
        """Looks at each file."""
        heads, frames, damages = [], [], []
        for file in files:
            with CompactReader(file) as reader:
                heads.append(reader.head)
                frames += reader.frames
                damages += [] if reader.damage is None else [reader.damage]
        return cls(name, beside, files, heads[0], frames, damages[0] if damages else None)

    def parts(self) -> NDArray[np.int64] | None:
        """[N] part of each Gaussian, by the last file."""
        with CompactReader(self.files[-1]) as reader:
            return reader.parts()

    def states(self, low: int, high: int) -> Iterator[tuple[int, float, Gaussians]]:
        """Index, time in seconds and state of the frames from ``low`` to ``high``."""
        for file in self.files:
            with CompactReader(file) as reader:
                for index, time in zip(reader.frames, reader.times.tolist(), strict=True):
                    if low <= index <= high:
                        yield index, time, reader.state(index)


def of_file(path: Path) -> CompactStates:
    """The states of a compact file.

    Raises:
        InputError: it is not there.
    """
    if not path.exists():
        raise InputError(
            f"source {str(path.parent)!r} holds no {path.name}", "give a folder that scas4d reconstruct left"
        )
    return CompactStates.of(path.stem, path.parent, [path])


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
        yield CompactStates.of(id[:8], Path(), files)


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
        raise InputError(f"frames {text!r} is no range", "give A:B, as 0:99; A: and :B are open at one end") from None
    if not 0 <= low <= high:
        raise InputError(f"frames {text!r} holds no frame", "give A:B with 0 ≤ A ≤ B")
    return low, high
