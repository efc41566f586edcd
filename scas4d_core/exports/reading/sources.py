"""Opens numbered files in a folder or .zip, a single .glb or .ply file, or a USD file.

Formats that do not identify Gaussians across frames are rejected.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData

from scas4d_core.errors import InputError
from scas4d_core.exports.cloud import Cloud
from scas4d_core.exports.reading.faults import translate_read_errors
from scas4d_core.exports.reading.gltf import GltfFrame
from scas4d_core.exports.reading.states import ExportedStates, default_header
from scas4d_core.exports.reading.usd import open_usd
from scas4d_core.exports.usd import SUFFIXES as USD_SUFFIXES
from scas4d_core.query.ply import SH_DEGREE_0, read_ply

DEFAULT_FPS = 30.0
"""Default frame rate of numbered files, which do not store times."""
NUMBERED = re.compile(r"frame_(\d+)(\.\w+)")
LOST = {
    ".splat": "its rows are sorted by size and have no ids",
    ".spz": "it has no ids",
    ".csv": "it contains only centres or poses",
}
REMEDY = "use a .s4d file, a USD file or numbered .glb files (scas4d export --format s4d, usd or glb)"
Bytes = Callable[[], bytes]
LARGEST = 1 << 30
"""Maximum uncompressed size of a frame in a .zip, in bytes; a small archive could otherwise exhaust memory."""


def open_export(path: Path | str, frames_per_second: float = DEFAULT_FPS) -> ExportedStates:
    """Opens an export as a sequence of states; frames are read one at a time.

    Args:
        path: folder or .zip of numbered .glb or .ply files, a single such file, or a USD file.
        frames_per_second: frame rate of numbered files; the time of frame n is n / frames_per_second.

    Raises:
        InputError: if the path is not a readable export, or its format does not identify Gaussians.

    >>> open_export("scene.splat")
    Traceback (most recent call last):
    scas4d_core.errors.InputError: 'scene.splat' cannot be read as states: its rows are sorted by size and ...
    """
    given = Path(path)
    suffix = given.suffix.lower()
    if suffix in LOST:
        raise InputError(f"{str(given)!r} cannot be read as states: {LOST[suffix]}", REMEDY)
    if not given.exists():
        raise InputError(f"{str(given)!r} does not exist", REMEDY)
    with translate_read_errors(given.name):
        return _opened(given, suffix, frames_per_second)


def _opened(given: Path, suffix: str, frames_per_second: float) -> ExportedStates:
    if suffix in USD_SUFFIXES:
        return open_usd(given)
    if given.is_dir():
        files = {file.name: file.read_bytes for file in given.iterdir() if file.is_file()}
        return _numbered(str(given), files, frames_per_second)
    if suffix == ".zip":
        return _numbered(str(given), _of_zip(given), frames_per_second)
    if suffix not in (".glb", ".ply"):
        raise InputError(f"{str(given)!r} is not a supported export", REMEDY)
    return _sequence(str(given), suffix, {_number(given.name): (given.name, given.read_bytes)}, frames_per_second)


def _number(name: str) -> int:
    match = NUMBERED.fullmatch(name)
    return int(match[1]) if match else 0


def _of_zip(path: Path) -> dict[str, Bytes]:
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError) as error:
        raise InputError(f"{str(path)!r} is not a .zip file ({error})", REMEDY) from None
    with archive:
        sizes = {each.filename: each.file_size for each in archive.infolist()}

    def read(name: str) -> bytes:
        if sizes[name] > LARGEST:
            raise InputError(f"{name} in {path.name} has {sizes[name]} bytes", f"a frame can have at most {LARGEST}")
        with zipfile.ZipFile(path) as opened:
            return opened.read(name)

    return {name: partial(read, name) for name in sizes}


def _numbered(source: str, files: dict[str, Bytes], rate: float) -> ExportedStates:
    matches = {name: match for name in sorted(files) if (match := NUMBERED.fullmatch(name))}
    suffixes = sorted({match[2].lower() for match in matches.values()})
    if lost := [suffix for suffix in suffixes if suffix in LOST]:
        raise InputError(f"{source!r} cannot be read as states: {lost[0]}: {LOST[lost[0]]}", REMEDY)
    if suffixes not in ([".glb"], [".ply"]):
        held = f"{', '.join(suffixes)} files" if suffixes else "no numbered files such as frame_000000.glb"
        raise InputError(f"{source!r} contains {held}", REMEDY)
    by_index = {int(match[1]): (name, files[name]) for name, match in matches.items()}
    if len(by_index) < len(matches):
        raise InputError(
            f"{source!r} has several files for one frame, such as frame_1 and frame_000001", "remove all but one"
        )
    return _sequence(source, suffixes[0], dict(sorted(by_index.items())), rate)


def _sequence(source: str, suffix: str, files: dict[int, tuple[str, Bytes]], rate: float) -> ExportedStates:
    if not 0 < rate < float("inf"):
        raise InputError(f"invalid frames_per_second {rate!r}", "use a positive number")
    frames, named = list(files), list(files.values())
    name, read = named[0]
    remarks = [f"numbered files have no times; assuming {rate:g} frames per second"] if len(frames) > 1 else []
    if NUMBERED.fullmatch(name) is None:
        remarks.append(
            f"{name} has no frame number; assuming frame 0 (for frame 13, rename it to frame_000013{suffix})"
        )
    cloud: Callable[[int], Cloud]
    if suffix == ".ply":
        rows = PlyRows(named)
        cloud, metres, deep = rows.cloud, 1.0, rows.glossy
        remarks.append("a .ply file has no unit; assuming metres")
    else:
        first = GltfFrame(read(), name)
        metres, deep = first.metres_per_unit, first.cloud().harmonics.shape[1] > 1

        def cloud(place: int) -> Cloud:
            name, read = named[place]
            return GltfFrame(read(), name).cloud()

    if deep:
        remarks.append("gloss is averaged over all directions")
    return ExportedStates(frames, [index / rate for index in frames], cloud, default_header(metres, rate), {}, remarks)


class PlyRows:
    """The .ply files of one sequence.

    Row numbers identify Gaussians, so all files must have the same rows. Rows are compared by
    opacity, because the opacity of a Gaussian never changes.

    Args:
        files: name of each file, and a function that returns its contents.

    Raises:
        InputError: if the first file is not a 3DGS .ply.
    """

    def __init__(self, files: list[tuple[str, Bytes]]) -> None:
        self._files = files
        vertex = _vertex(*files[0])
        self._opacities: NDArray[np.float64] = np.asarray(vertex["opacity"], np.float64)
        self.glossy = any(name.startswith("f_rest_") for name in vertex.data.dtype.names)

    def cloud(self, place: int) -> Cloud:
        """Returns the Gaussians of a frame in the user's world; ids are row numbers.

        Raises:
            InputError: if the frame does not have the same Gaussians as the first.
        """
        name, read = self._files[place]
        splats = read_ply(io.BytesIO(read()), name)
        own = np.asarray(_vertex(name, read)["opacity"], np.float64)
        if not np.array_equal(own, self._opacities):
            raise InputError(
                f"{name} does not have the same Gaussians as {self._files[0][0]}, and .ply files have no ids to match "
                "them",
                REMEDY,
            )
        return Cloud(splats, (splats.colours[:, None] - 0.5) / SH_DEGREE_0, np.arange(len(splats), dtype=np.int64))


def _vertex(name: str, read: Bytes) -> PlyData:
    try:
        return PlyData.read(io.BytesIO(read()))["vertex"]
    except Exception as error:
        raise InputError(f"{name} is not a 3D Gaussian Splatting .ply file ({error})", REMEDY) from None
