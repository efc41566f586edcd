"""Implementation of `scas4d export --player`, which writes a self-contained HTML file that plays a sequence offline."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from client.exports.modules import script
from client.exports.sources import STATES, CompactStates, Source, frame_range, opened
from client.progress import console
from scas4d_core.cameras import Camera, Rig
from scas4d_core.compact import CompactReader, CompactWriter
from scas4d_core.errors import InputError

VIEWER = Path(__file__).parents[2] / "server" / "viewer"
"""Folder of the viewer's modules, which the player reuses."""
PIECE = 3 << 18
"""Chunk size in bytes. It is a multiple of 3, so each base64 chunk can be decoded separately."""
LARGE, LARGEST = 100 << 20, 1 << 30
"""Size limits of the embedded data in bytes. Above the first, pages open slowly. Above the second, they do not open."""


def export_player(source: str, out: Path, frames: str | None = None, *, url: str, token: str | None) -> None:
    """Writes an HTML player for the frames of a source.

    The player contains the compact files of the source, or a new compact file if only some of their frames are
    requested.

    Args:
        source: compact file, output folder of `scas4d reconstruct`, or id of a scene on the service.
        out: HTML file to write.
        frames: inclusive range `A:B`; None for all frames.
        url: service URL.
        token: access token for the service.

    Raises:
        InputError: if the range or output is invalid, or the data is larger than browsers can open.
    """
    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"player={str(out)!r} is not an HTML file name", "use a name that ends in .html")
    low, high = frame_range(frames)
    with opened(source, low, high, True, url, token) as given:
        if given.of.damage is not None:
            console.print(f"only part of the source can be read: {given.of.damage}", soft_wrap=True)
        count = len(given.within(low, high))
        with _files(given, low, high, count) as files:
            size = sum(file.stat().st_size for file in files)
            if size > LARGEST:
                raise InputError(
                    f"the frames take {size / 1e6:.0f} MB, which is more than a browser can load in one page",
                    "export fewer with --frames A:B",
                )
            folder = given.beside.resolve().name  # `scas4d reconstruct` always uses the same file name
            write_player(out, folder if f"{given.name}.s4d" == STATES and folder else given.name, files)
    console.print(f"{count} frames in {out}, {out.stat().st_size / 1e6:.1f} MB; open it in a browser", soft_wrap=True)
    if size > LARGE:
        console.print("the page is large and slow to open; use --frames A:B to make it smaller", soft_wrap=True)


def write_player(out: Path, title: str, files: Sequence[Path]) -> None:
    """Writes an HTML page with embedded compact files, keeping only one chunk in memory at a time.

    Args:
        out: HTML file to write.
        title: page title.
        files: compact files in frame order.
    """
    from scas4d_core.exports.atomic_files import atomic_path  # imported lazily: it loads the dependencies of exports

    parts = {
        "title": html.escape(title),
        "style": (VIEWER / "player" / "player.css").read_text(encoding="utf-8"),
        "worker": script(VIEWER / "splats" / "worker.js", VIEWER),
        "script": script(VIEWER / "player" / "player.js", VIEWER),
    }
    before, _, after = (VIEWER / "player" / "player.html").read_text(encoding="utf-8").partition("{{files}}")
    out.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(out) as working, working.open("w", encoding="utf-8") as page:
        page.write(_filled(before, parts))
        for file in files:
            page.write(f'<div class="file" data-bytes="{file.stat().st_size}" hidden>\n')
            for piece in _pieces(file):
                page.write(f'<script type="application/octet-stream">{piece}</script>\n')
            page.write("</div>\n")
        page.write(_filled(after, parts))


def _filled(text: str, parts: dict[str, str]) -> str:
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match.group(1)], text)


def _pieces(file: Path) -> Iterator[str]:
    with file.open("rb") as data:
        while piece := data.read(PIECE):
            yield base64.b64encode(piece).decode()


@contextmanager
def _files(given: Source, low: int, high: int, count: int) -> Iterator[Sequence[Path]]:
    """Yields the source's compact files, or a new one if it has none or they contain unrequested frames."""
    if isinstance(given.of, CompactStates) and count == _held(given.of.files):
        yield given.of.files
        return
    parts = given.parts()
    with TemporaryDirectory() as folder:
        file = Path(folder) / "some.s4d"
        head = given.head
        if head.rig is None:
            _, _, first = next(given.states(low, high))
            head = replace(head, rig=Rig((_facing(head.world.to_user(first.means)),)))
        with CompactWriter(file, head) as writer:
            index = known = 0
            for index, time, state in given.states(low, high):
                writer.add(index, time, state)
                known = len(state)
            if parts is not None and len(parts) >= known:
                writer.add_parts(index, parts[:known])
        yield [file]


def _facing(points: NDArray[np.float64]) -> Camera:
    """Returns a camera that looks along +z at points [N, 3] in the user's world, for sources without cameras.

    >>> camera = _facing(np.array([[0.0, 0, 5], [1, 0, 5], [0, 1, 5], [1, 1, 5]]))
    >>> pixels, depth = camera.project(np.array([[0.5, 0.5, 5]]))
    >>> pixels.round(3).tolist(), bool(depth[0] > 1)
    ([[320.0, 240.0]], True)
    """
    low, high = np.percentile(points, 2, axis=0), np.percentile(points, 98, axis=0)
    centre, extent = (low + high) / 2, float(max((high - low).max(), 1e-9))
    pose = np.eye(4)
    pose[:3, 3] = np.array([0.0, 0.0, 1.8 * extent]) - centre
    return Camera("front", np.array([[640.0, 0, 320], [0, 640, 240], [0, 0, 1]]), pose, 640, 480)


def _held(files: Sequence[Path]) -> int:
    """Returns the number of frames in compact files, including frames that are only needed to decode others."""
    indices: set[int] = set()
    for file in files:
        with CompactReader(file) as reader:
            indices.update(reader.frames)
    return len(indices)
