"""`scas4d export`: states of a compact file, or of a scene of the service, in the formats of other tools."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
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
    from scas4d_core.exports.formats import format_of
    from scas4d_core.exports.sequence import export_sequence

    wanted = format_of(format)
    low, high = frame_range(frames)
    path = Path(source)
    with ExitStack() as opened, Bars() as bars:
        if path.exists():
            files: CompactStates = opened.enter_context(of_file(path / STATES if path.is_dir() else path))
        elif path.suffix or len(path.parts) > 1:
            raise InputError(f"source {source!r} is not there", "give a compact file, its folder, or a scene's id")
        else:
            files = opened.enter_context(of_scene(source, low, high, wanted.needs_parts or format == "usd", url, token))
        target = out or files.beside / f"{files.name}-{format}{'' if wanted.numbered else wanted.suffixes[0]}"
        if files.damage is not None:
            console.print(f"only a part can be read: {files.damage}", soft_wrap=True)
        chosen = [index for index in files.frames if low <= index <= high]
        if not chosen:
            held = f"{files.frames[0]} to {files.frames[-1]}" if files.frames else "none"
            raise InputError(f"frames {frames!r} holds no frame of {source}", f"it has frames {held}")
        paths = export_sequence(
            files.states(chosen),
            format,
            target,
            world=files.head.world,
            rig=files.head.rig,
            parts=files.parts,
            ids=ids,
            frames_per_second=files.head.frames_per_second,
            progress=lambda index, done: bars("exporting", done, len(chosen)),
        )
    what = f"{len(paths)} files in {target}" if wanted.numbered else f"{len(chosen)} frames in {target}"
    console.print(f"{what} ({format}; docs/exports.md says what each format holds)", soft_wrap=True)


@dataclass(frozen=True)
class CompactStates:
    """States of one compact file or of several, one after the other.

    Attributes:
        name, beside: of outputs. readers: in the order of their frames.
    """

    name: str
    beside: Path
    readers: Sequence[CompactReader]

    @property
    def head(self) -> Head:
        """Of the first file."""
        return self.readers[0].head

    @property
    def frames(self) -> list[int]:
        """Of all files."""
        return [index for reader in self.readers for index in reader.frames]

    @property
    def parts(self) -> NDArray[np.int64] | None:
        """Of the last file."""
        return self.readers[-1].parts()

    @property
    def damage(self) -> str | None:
        """Of the first file that has any."""
        return next((reader.damage for reader in self.readers if reader.damage is not None), None)

    def states(self, chosen: Collection[int]) -> Iterator[tuple[int, float, Gaussians]]:
        """Index, time in seconds and state of the chosen frames."""
        for reader in self.readers:
            for index, time in zip(reader.frames, reader.times.tolist(), strict=True):
                if index in chosen:
                    yield index, time, reader.state(index)


@contextmanager
def of_file(path: Path) -> Iterator[CompactStates]:
    """The states of a compact file."""
    with CompactReader(path) as reader:
        yield CompactStates(path.stem, path.parent, [reader])


@contextmanager
def of_scene(id: str, low: int, high: int, parts: bool, url: str, token: str | None) -> Iterator[CompactStates]:
    """The states of a scene, fetched from the service to temporary files.

    Args:
        low, high: first and last frame. parts: with the part of each Gaussian.
    """
    with ExitStack() as opened:
        client = opened.enter_context(Client(url, token=token, outage=0))
        folder = Path(opened.enter_context(TemporaryDirectory()))
        readers: list[CompactReader] = []
        following: int | None = low
        while following is not None and following <= high:
            data, following = client.states(id, following, min(MOST, high - following + 1), parts)
            file = folder / f"{len(readers)}.s4d"
            file.write_bytes(data)
            readers.append(opened.enter_context(CompactReader(file)))
        yield CompactStates(id[:8], Path(), readers)


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
