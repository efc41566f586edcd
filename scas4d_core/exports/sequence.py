"""Exports a sequence of frames as numbered files in a folder or ``.zip``, or as one file, depending on the format."""

from __future__ import annotations

import re
import tempfile
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

from numpy.typing import ArrayLike, NDArray

from scas4d_core.cameras import Rig, WorldFrame
from scas4d_core.errors import InputError
from scas4d_core.exports.atomic_files import AtomicWriter, translate_write_errors
from scas4d_core.exports.compact_states import Colour, CompactSequence
from scas4d_core.exports.formats import Format, check_suffix, format_of
from scas4d_core.exports.gltf import write_glb
from scas4d_core.exports.gltf_parts import PartAsset
from scas4d_core.exports.splat import write_splat
from scas4d_core.exports.spz import write_spz
from scas4d_core.exports.tables import PoseTable, TrackTable
from scas4d_core.exports.usd import UsdSequence
from scas4d_core.gaussians import Gaussians
from scas4d_core.query.ply import write_ply

Progress = Callable[[int, int], None]
"""Callback that receives the index of a completed frame and the number of completed frames."""

FRAME_WRITERS: dict[str, Callable[[Path, Gaussians, WorldFrame], None]] = {
    "ply": write_ply,
    "splat": write_splat,
    "spz": write_spz,
    "spz4": lambda path, gaussians, world: write_spz(path, gaussians, world, version=4),
    "glb": write_glb,
}
"""Maps each format with numbered files to the function that writes one frame."""


class SequenceWriter(Protocol):
    """Interface of a writer that adds frames to one output."""

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame."""

    def finish(self) -> None:
        """Completes the output."""

    def discard(self) -> None:
        """Removes the incomplete output."""


def export_sequence(
    states: Iterable[tuple[int, float, Gaussians]],
    format: str,
    out: Path | str,
    *,
    world: WorldFrame,
    rig: Rig | None = None,
    parts: NDArray[Any] | None = None,
    ids: ArrayLike | None = None,
    frames_per_second: float | None = None,
    background: Colour = (0.0, 0.0, 0.0),
    progress: Progress | None = None,
) -> list[Path]:
    """Exports frames in the given format. Frames are read and written one at a time.

    Numbered files are named ``frame_000012.ply`` for frame 12. Each file is written atomically and replaces any
    existing file. A ``.zip`` or a single file appears only when it is complete. After an error, complete numbered files
    remain in a folder; other outputs are removed.

    Args:
        states: index, time in seconds, and state in the internal world of each frame, in increasing order.
            For a ``CompactReader``: ``((i, t, reader.state(i)) for i, t in zip(reader.frames, reader.times))``.
        format: name of the format, one of ``FORMATS``.
        out: output path: a folder (created if missing) or ``.zip`` for numbered files, otherwise a file with the
            format's suffix.
        world: transform from the user's world to the internal world.
        rig: rig in the user's world; used by USD and ``s4d``, and required for ``tapvid-mv``.
        parts: [N] part label of each Gaussian, negative for none; used by ``glb-parts``, ``poses``, USD and ``s4d``.
        ids: ids of the Gaussians to write for ``tracks`` and ``tapvid-mv``. If None, ``tracks`` contains all moving
            Gaussians, and ``tapvid-mv`` up to ``MAX_TRACKS`` (``track_rows``).
        frames_per_second: nominal frame rate for ``s4d``, and rate of USD's time codes. If None,
            the rate of the time codes is derived from the first two frames.
        background: background colour, RGB in [0, 1]; used by ``s4d`` and ``tapvid-mv``.
        progress: function called after each frame.

    Returns:
        The paths of the numbered files, or of the single file.

    Raises:
        InputError: if the format is unknown, there is no frame, parts, a rig or a package are missing, no frame
            contains one of the ids, the output cannot be written, or Gaussians cannot be exported. Exceptions from
            ``states`` propagate unchanged.

    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     frames = ((index, index / 30, state) for index in (3, 4))
    ...     paths = export_sequence(frames, "ply", f"{folder}/out", world=WorldFrame(np.zeros(3)))
    ...     [path.name for path in paths]
    ['frame_000003.ply', 'frame_000004.ply']
    """
    wanted = format_of(format)
    target = Path(out)
    if wanted.needs_parts and parts is None:
        raise InputError(f"format {format!r} requires parts, but parts is None", "pass one label per Gaussian")
    if wanted.needs_rig and rig is None:
        raise InputError(f"format {format!r} requires cameras, but rig is None", "pass a rig")
    if frames_per_second is not None and not 0 < frames_per_second < float("inf"):
        raise InputError(f"invalid frames_per_second {frames_per_second!r}", "use a positive number or None")
    if not wanted.numbered:
        check_suffix(target, wanted)
    coming = iter(states)
    waiting = list(islice(coming, 1))
    if not waiting:
        raise InputError("states has no frames", "use a range that contains at least one committed frame")
    writer = _writer(wanted, target, world, rig, parts, ids, frames_per_second, background)
    done = 0
    paths: list[Path] = []
    try:
        for index, time, state in _chain(waiting, coming):
            writer.add(index, float(time), state)
            done += 1
            if isinstance(writer, _Folder):
                paths.append(writer.path_of(index))
            if progress is not None:
                progress(index, done)
        writer.finish()
    except BaseException:
        writer.discard()
        raise
    return paths or [target]


def other_frames(out: Path, format: Format, frames: Collection[int]) -> list[Path]:
    """Returns the folder's numbered files of this format for other frames, such as files left by an earlier export.

    >>> other_frames(Path("no_such_folder"), format_of("ply"), [0])
    []
    """
    if not format.numbered or not out.is_dir():
        return []
    pattern = re.compile(rf"frame_(\d+){re.escape(format.suffixes[0])}")
    names = ((path, pattern.fullmatch(path.name)) for path in sorted(out.iterdir()))
    return [path for path, match in names if match and int(match[1]) not in frames]


def _chain(
    waiting: list[tuple[int, float, Gaussians]], coming: Iterator[tuple[int, float, Gaussians]]
) -> Iterator[tuple[int, float, Gaussians]]:
    """Yields the waiting frame and then the others, without keeping references to yielded frames."""
    yield waiting.pop()
    yield from coming


def _writer(
    wanted: Format,
    target: Path,
    world: WorldFrame,
    rig: Rig | None,
    parts: NDArray[Any] | None,
    ids: ArrayLike | None,
    frames_per_second: float | None,
    background: Colour,
) -> SequenceWriter:
    if wanted.numbered:
        return (_Zip if target.suffix.lower() == ".zip" else _Folder)(target, wanted, world)
    if wanted.name == "usd":
        return UsdSequence(target, world, rig, parts, frames_per_second)
    if wanted.name == "s4d":
        return CompactSequence(target, world, rig, parts, frames_per_second, background)
    if wanted.name == "tracks":
        return TrackTable(target, world, ids)
    if wanted.name == "tapvid-mv":
        from scas4d_core.exports.tapvid_mv import TapVidMvSequence  # deferred import: only this format renders

        assert rig is not None  # checked by ``export_sequence``
        return TapVidMvSequence(target, world, rig, ids, background)
    assert parts is not None  # required by the remaining formats
    of_parts: dict[str, type[PartAsset | PoseTable]] = {"glb-parts": PartAsset, "poses": PoseTable}
    return of_parts[wanted.name](target, world, parts)


class _Folder:
    """Numbered files in a folder."""

    def __init__(self, folder: Path, format: Format, world: WorldFrame) -> None:
        self.folder, self._format, self._world = folder, format, world
        with translate_write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)

    def path_of(self, index: int) -> Path:
        """Returns the path of a frame's file."""
        return self.folder / f"frame_{index:06d}{self._format.suffixes[0]}"

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Writes the file of a frame."""
        with translate_write_errors(self.folder):
            FRAME_WRITERS[self._format.name](self.path_of(index), gaussians, self._world)

    def finish(self) -> None:
        """Does nothing, because each file is already complete."""

    def discard(self) -> None:
        """Keeps the complete files."""


class _Zip(AtomicWriter):
    """Numbered files in an uncompressed ``.zip``.

    Each file is first written to a temporary folder, which contains at most one file at a time.
    """

    def __init__(self, path: Path, format: Format, world: WorldFrame) -> None:
        self._format, self._world = format, world
        super().__init__(path)

    def _open(self, stack: ExitStack, beside: Path) -> None:
        self._archive = stack.enter_context(zipfile.ZipFile(beside, "w", zipfile.ZIP_STORED))
        temporary = stack.enter_context(tempfile.TemporaryDirectory(prefix=".part-", dir=beside.parent))
        self._folder = _Folder(Path(temporary), self._format, self._world)

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds the file of a frame."""
        self._folder.add(index, time, gaussians)
        file = self._folder.path_of(index)
        with translate_write_errors(self.path):
            self._archive.write(file, file.name)
            file.unlink()
