"""Implementation of `scas4d export`, which converts states from a file, an export or a scene to third-party formats."""

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
    """Exports frames to a file or folder, keeping only one state in memory at a time.

    Args:
        source: source of the states; see `opened`.
        format: format name from docs/exports.md.
        out: output folder or `.zip` for a format with one file per frame, otherwise the output file. If None, the
            output is named after the source and format. It is written next to the source or, for a scene, to the
            current folder.
        frames: inclusive range `A:B`, where A or B may be omitted; None for all frames.
        ids: ids of the Gaussians to export, for formats that accept them.
        rate: frame rate of a source that consists of numbered files; None for the default of 30 frames per second.
        url: service URL.
        token: access token for the service.

    Raises:
        InputError: if the source, format, range or output is invalid.
    """
    from scas4d_core.exports.formats import WITH_PARTS, check_suffix, format_of, formats_with_ids
    from scas4d_core.exports.sequence import export_sequence, other_frames

    wanted = format_of(format)
    low, high = frame_range(frames)
    if ids and not wanted.accepts_ids:
        raise InputError(
            f"id cannot be used with format {format!r}", f"omit --id, or use {' or '.join(formats_with_ids())}"
        )
    if out is not None and not wanted.numbered:
        check_suffix(out, wanted)
    elif out is not None and out.suffix.lower() in wanted.suffixes:
        raise InputError(
            f"out {str(out)!r} is a file name, but {format} writes one file per frame",
            f"use a folder, or {out.stem}.zip",
        )
    with_parts = wanted.needs_parts or format in WITH_PARTS
    with opened(source, low, high, with_parts, url, token, rate) as states, Bars() as bars:
        given = states.of
        target = out or states.beside / f"{states.name}-{format}{'' if wanted.numbered else wanted.suffixes[0]}"
        for remark in given.remarks:
            console.print(remark, soft_wrap=True)
        if given.damage is not None:
            console.print(f"only part of the source can be read: {given.damage}", soft_wrap=True)
        chosen = list(states.within(low, high))
        count = len(chosen)
        if others := other_frames(target, wanted, chosen):
            raise InputError(
                f"out {str(target)!r} contains {len(others)} files of frames that are not in this export, such as "
                f"{others[0].name}; readers would treat all files as one sequence",
                "remove them, or choose another folder with --out",
            )
        parts = given.parts() if with_parts else None
        if wanted.needs_parts and parts is None:
            raise InputError(f"{source} has no parts, but format {format!r} requires them", "use a source with parts")
        if wanted.needs_rig and given.head.rig is None:
            raise InputError(f"{source} has no cameras, but format {format!r} requires them", "use a source with a rig")
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
    console.print(f"{what} ({format}; see docs/exports.md for the contents of each format)", soft_wrap=True)
