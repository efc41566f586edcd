"""`scas4d export`: states of a compact file, an export, or a scene of the service, in the formats of other tools."""

from __future__ import annotations

from pathlib import Path

from client.exports.sources import frame_range, opened
from client.progress import Bars, console
from scas4d_core.errors import InputError


def export(
    source: str,
    format: str,
    out: Path | None,
    frames: str | None = None,
    ids: list[int] | None = None,
    rate: float | None = None,
    *,
    url: str,
    token: str | None,
) -> None:
    """Exports frames; one state is in memory at a time.

    Args:
        source: as `opened` takes it.
        format: a name of docs/exports.md. out: a folder or `.zip` for numbered files, else a file; None: beside the
            file, or in this folder for a scene, named after it and the format.
        frames: `A:B`, the frames from A to B, both counted in; either may be left out. None: all. ids: of tracks.
        rate: frames a second of a source of numbered files.
        url, token: of the service.

    Raises:
        InputError: a source, a format, a range or an output that cannot be.
    """
    from scas4d_core.exports.formats import WITH_PARTS, check_suffix, format_of
    from scas4d_core.exports.sequence import export_sequence, other_frames

    wanted = format_of(format)
    low, high = frame_range(frames)
    if ids and format != "tracks":
        raise InputError(f"id is given for format {format!r}", "leave --id out; it chooses the Gaussians of tracks")
    if out is not None and not wanted.numbered:
        check_suffix(out, wanted)
    elif out is not None and out.suffix.lower() in wanted.suffixes:
        raise InputError(
            f"out {str(out)!r} is the name of one file, and {format} has one for each frame",
            f"give a folder, or {out.stem}.zip",
        )
    with_parts = wanted.needs_parts or format in WITH_PARTS
    with opened(source, low, high, with_parts, url, token, rate) as states, Bars() as bars:
        given = states.of
        target = out or states.beside / f"{states.name}-{format}{'' if wanted.numbered else wanted.suffixes[0]}"
        for remark in given.remarks:
            console.print(remark, soft_wrap=True)
        if given.damage is not None:
            console.print(f"only a part can be read: {given.damage}", soft_wrap=True)
        chosen = list(states.within(low, high))
        count = len(chosen)
        if others := other_frames(target, wanted, chosen):
            raise InputError(
                f"out {str(target)!r} holds {len(others)} files of frames that are not in this export, as "
                f"{others[0].name}; readers would take them for one with it",
                "remove them, or give another folder: --out",
            )
        parts = given.parts() if with_parts else None
        if wanted.needs_parts and parts is None:
            raise InputError(f"{source} has no parts, and {format} is made of them", "take a source with parts")
        paths = export_sequence(
            given.states(low, high),
            format,
            target,
            world=given.head.world,
            rig=given.head.rig,
            parts=parts,
            ids=ids,
            frames_per_second=given.head.frames_per_second,
            background=given.head.background,
            progress=lambda index, done: bars("exporting", done, count),
        )
    what = f"{len(paths)} files in {target}" if len(paths) > 1 else f"{count} frames in {target}"
    console.print(f"{what} ({format}; docs/exports.md says what each format holds)", soft_wrap=True)
