"""Writes tracks, rendered images and depth in the layout of the multi-view benchmark TAPVid-MV.

The layout is that of a sequence of the dataset (google-deepmind/tapnet, ``tapvidmv``). The ``.zip`` contains:

- ``tracks_xyz.npy``: [T, N, 3] float32 positions.
- ``queries_xytv.npy``: [N, 4] float32 u, v, frame and view of each query; −1, −1, 0, 0 if a track is never visible.
- ``0/``, ``1/``, …: one folder for each camera, in the order of the rig:

  - ``images_jpeg_bytes.npy``: [T] JPEG files, as a pickled array of uint8 arrays.
  - ``depth.npy``: [T, H, W] float32 z along the camera's axis; 0 if less than half of the pixel is covered.
  - ``visibility.npy``: [T, N] bool.
  - ``intrinsics.npy``: [4] float32 fx, fy, cx, cy in pixels.
  - ``extrinsics_w2c.npy``: [T, 4, 4] float32 transforms from the world to the camera.

Positions and depths are in metres, in the axes of the user's world. Pixel centres are at +0.5.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from scas4d_core.cameras import Camera, Rig, WorldFrame
from scas4d_core.engines.limits import rig_limits
from scas4d_core.errors import InputError
from scas4d_core.exports.atomic_files import atomic_path, translate_write_errors
from scas4d_core.gaussians import Gaussians, moving_extent
from scas4d_core.query.view import ViewRenderer
from scas4d_core.query.visibility import visible_points

MAX_TRACKS = 500
"""Maximum number of tracks if no ids are given, evenly spaced over the moving rows of the first frame."""
JPEG_QUALITY = 95
"""Quality of the images, as in the benchmark."""
QUERY_SEED = 0
"""Seed for the frame and view of each query. They are drawn from those in which the track is visible."""


@dataclass
class _View:
    """What has been written for one camera: sizes [T] of the JPEG files in bytes, and visibility [T] of [N]."""

    camera: Camera
    folder: Path
    sizes: list[int] = field(default_factory=list)
    visible: list[NDArray[np.bool_]] = field(default_factory=list)


class TapVidMvSequence:
    """Writer of a ``.zip`` in the layout of TAPVid-MV.

    Images and depths are written to a temporary folder next to the file, one frame at a time. The ``.zip`` is written
    by ``finish``.

    Args:
        path: path of the file.
        world: transform from the user's world to the internal world.
        rig: cameras in the user's world.
        ids: ids of the Gaussians whose centres are the tracks, which are written in ascending order. If None, up to
            ``MAX_TRACKS`` moving Gaussians are written.
        background: background colour of the images, RGB in [0, 1].

    Raises:
        InputError: if the file cannot be written.

    >>> from tempfile import TemporaryDirectory
    >>> camera = Camera("front", [[100, 0, 32], [0, 100, 24], [0, 0, 1]], np.eye(4), 64, 48)
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1)
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "scene.zip"
    ...     sequence = TapVidMvSequence(path, WorldFrame(np.zeros(3)), Rig((camera,)))
    ...     sequence.add(7, 0.5, state)
    ...     sequence.finish()
    ...     with zipfile.ZipFile(path) as archive, archive.open("tracks_xyz.npy") as tracks:
    ...         np.load(tracks)
    array([[[0., 0., 2.]]], dtype=float32)
    """

    def __init__(
        self,
        path: Path | str,
        world: WorldFrame,
        rig: Rig,
        ids: ArrayLike | None = None,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> None:
        self.path = Path(path)
        self._world, self._background = world, background
        self._ids = None if ids is None else np.unique(np.asarray(ids, np.int64))
        self._extent = 0.0
        self._limits = rig_limits("auto", world, rig.cameras)
        self._renderer = ViewRenderer(world, self._limits)
        self._tracks: list[NDArray[np.float64]] = []
        with translate_write_errors(self.path):
            self._temporary = tempfile.TemporaryDirectory(prefix=".part-", dir=self.path.parent)
        self._views = [_View(camera, Path(self._temporary.name) / str(k)) for k, camera in enumerate(rig.cameras)]
        for view in self._views:
            view.folder.mkdir()

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame, given its index, its time in seconds, and its state in the internal world.

        Raises:
            InputError: if no Gaussian of the first frame moves and no ids are given, or the disk is full.
        """
        if not self._tracks:
            self._extent = moving_extent(gaussians)
            if self._ids is None:
                self._ids = _evenly_spaced(gaussians)
        assert self._ids is not None
        positions = np.full((len(self._ids), 3), np.nan)
        _, columns, rows = np.intersect1d(self._ids, gaussians.ids, return_indices=True)
        there = gaussians.present[rows]
        positions[columns[there]] = self._world.to_user(gaussians.means[rows[there]])
        self._tracks.append(positions)
        for view in self._views:
            rendered = self._renderer.render(gaussians, view.camera, self._background)
            levels = np.clip(255 * rendered.colour + 0.5, 0, 255).astype(np.uint8)
            encoded = io.BytesIO()
            Image.fromarray(levels).save(encoded, "JPEG", quality=JPEG_QUALITY)
            depth = np.nan_to_num(rendered.depth * np.float32(self._world.metres_per_unit), nan=0.0)
            view.sizes.append(encoded.tell())
            view.visible.append(
                visible_points(gaussians, self._world, positions, view.camera, self._extent, self._limits)
            )
            with translate_write_errors(self.path):
                _append(view.folder / "jpeg", encoded.getvalue())
                _append(view.folder / "depth", depth.astype("<f4").tobytes())

    def finish(self) -> None:
        """Writes the ``.zip`` atomically, one camera at a time.

        Raises:
            InputError: if the file cannot be written.
        """
        try:
            with atomic_path(self.path) as beside, zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED) as archive:
                self._write(archive)
        finally:
            self.discard()

    def discard(self) -> None:
        """Removes the temporary files."""
        self._temporary.cleanup()

    def _write(self, archive: zipfile.ZipFile) -> None:
        metres, count = self._world.metres_per_unit, len(self._tracks)
        tracks = np.stack(self._tracks)
        visible = [np.stack(view.visible) for view in self._views]
        _save(archive, "tracks_xyz.npy", (tracks * metres).astype(np.float32))
        queries = _queries(tracks, visible, [view.camera for view in self._views])
        _save(archive, "queries_xytv.npy", queries)
        for view, seen in zip(self._views, visible, strict=True):
            camera, inside = view.camera, view.folder.name
            lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
            pose = camera.world_to_camera.copy()
            pose[:3, 3] *= metres
            _save(archive, f"{inside}/intrinsics.npy", lens)
            _save(archive, f"{inside}/extrinsics_w2c.npy", np.repeat(pose[None].astype(np.float32), count, axis=0))
            _save(archive, f"{inside}/visibility.npy", seen)
            depth = np.memmap(view.folder / "depth", "<f4", "r", shape=(count, camera.height, camera.width))
            _save(archive, f"{inside}/depth.npy", depth)
            files = np.empty(count, dtype=object)
            with (view.folder / "jpeg").open("rb") as encoded:
                files[:] = [np.frombuffer(encoded.read(size), np.uint8) for size in view.sizes]
            _save(archive, f"{inside}/images_jpeg_bytes.npy", files)


def _evenly_spaced(first: Gaussians) -> NDArray[np.int64]:
    moving = np.flatnonzero(first.moving)
    if not moving.size:
        raise InputError("no Gaussian of the first frame moves", "pass the ids of the Gaussians to export")
    even = np.linspace(0, len(moving) - 1, min(MAX_TRACKS, len(moving))).round().astype(np.intp)
    return first.ids[moving[even]]


def _queries(
    tracks: NDArray[np.float64], visible: list[NDArray[np.bool_]], cameras: list[Camera]
) -> NDArray[np.float32]:
    """Draws the query [N, 4] of each track: u, v, frame and view."""
    draw = np.random.default_rng(QUERY_SEED)
    queries = np.tile(np.array([-1, -1, 0, 0], np.float32), (tracks.shape[1], 1))
    seen = np.stack(visible, axis=-1)  # [T, N, views]
    for n in range(tracks.shape[1]):
        choices = np.argwhere(seen[:, n])
        if len(choices):
            t, view = choices[draw.integers(len(choices))]
            uv, _ = cameras[view].project(tracks[t, n])
            queries[n] = [*uv, t, view]
    return queries


def _append(path: Path, content: bytes) -> None:
    with path.open("ab") as file:
        file.write(content)


def _save(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    """Adds an array to the archive in the ``.npy`` format."""
    with archive.open(name, "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array)
