"""`scas4d export`: the states of a compact file in the formats of other tools."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from client.cli.progress import Bars, console
from scas4d_core.compact import CompactReader
from scas4d_core.errors import InputError
from scas4d_core.gaussians import Gaussians

STATES = "states.s4d"
"""The compact file that `scas4d reconstruct` leaves in its folder."""


def export(file: Path, format: str, out: Path | None, frames: str | None = None, ids: list[int] | None = None) -> None:
    """Exports frames of a compact file; one state is in memory at a time.

    Args:
        file: a compact file, or the folder in which `scas4d reconstruct` left one. format: a name of docs/exports.md.
        out: a folder or `.zip` for numbered files, else a file; None: beside the file, named after the format.
        frames: `A:B`, the frames from A to B, both counted in; either may be left out. None: all. ids: of tracks.

    Raises:
        InputError: a format, a range or an output that cannot be.
    """
    from scas4d_core.exports.formats import format_of
    from scas4d_core.exports.sequence import export_sequence

    wanted = format_of(format)
    with CompactReader(file / STATES if file.is_dir() else file) as reader, Bars() as bars:
        if reader.damage is not None:
            console.print(f"only a part of the file can be read: {reader.damage}", soft_wrap=True)
        chosen = frames_of(frames, reader.frames)
        suffix = "" if wanted.numbered else wanted.suffixes[0]
        target = out or reader.path.with_name(f"{reader.path.stem}-{format}{suffix}")
        times = dict(zip(reader.frames, reader.times.tolist(), strict=True))

        def states() -> Iterator[tuple[int, float, Gaussians]]:
            for index in chosen:
                yield index, times[index], reader.state(index)

        paths = export_sequence(
            states(),
            format,
            target,
            world=reader.head.world,
            rig=reader.head.rig,
            parts=reader.parts(),
            ids=ids,
            frames_per_second=reader.head.frames_per_second,
            progress=lambda index, done: bars("exporting", done, len(chosen)),
        )
    what = f"{len(paths)} files in {target}" if wanted.numbered else f"{len(chosen)} frames in {target}"
    console.print(f"{what} ({format}; docs/exports.md says what each format holds)", soft_wrap=True)


def frames_of(text: str | None, known: list[int]) -> list[int]:
    """The frames of a range among those that there are.

    >>> frames_of("2:4", [0, 1, 2, 3, 4, 5]), frames_of(":1", [0, 1, 2]), frames_of("7", [6, 7])
    ([2, 3, 4], [0, 1], [7])
    """
    if text is None:
        return known
    first, colon, last = text.partition(":")
    try:
        low = int(first) if first else 0
        high = (int(last) if last else max(known, default=0)) if colon else low
    except ValueError:
        raise InputError(f"frames {text!r} is no range", "give A:B, as 0:99; A: and :B are open at one end") from None
    chosen = [index for index in known if low <= index <= high]
    if not chosen:
        held = f"{known[0]} to {known[-1]}" if known else "none"
        raise InputError(f"frames {text!r} holds no frame of the file", f"it has frames {held}")
    return chosen
