"""Writes tracks, rendered images and depth in the layout of the multi-view benchmark TAPVid-MV.

The layout is that of a sequence of the dataset (google-deepmind/tapnet, ``tapvidmv``). The ``.zip`` contains:

- ``scas4d.json``: names of the cameras in the order of their folders, frame numbers, times in seconds, and the ids of
  the Gaussians that are tracked. The benchmark does not read this file.
- ``tracks_xyz.npy``: [T, N, 3] float32 positions, NaN while a Gaussian is absent.
- ``queries_xytv.npy``: [N, 4] float32 u, v, frame and view of each query. The frame and view are drawn from those in
  which the track is visible; tracks that are never visible are omitted.
- ``0/``, ``1/``, …: one folder for each camera, in the order of the rig:

  - ``images_jpeg_bytes.npy``: [T] JPEG files, as a pickled array of uint8 arrays.
  - ``depth.npy``: [T, H, W] float32 z along the camera's axis; 0 if less than half of the pixel is covered.
  - ``visibility.npy``: [T, N] bool.
  - ``intrinsics.npy``: [4] float32 fx, fy, cx, cy in pixels.
  - ``extrinsics_w2c.npy``: [T, 4, 4] float32 transforms from the world to the camera.

Positions and depths are in metres, in the user's world. As in the dataset, the centre of the first pixel is at (0, 0).
"""

from __future__ import annotations

import io
import json
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
from scas4d_core.engines.renderer import levels
from scas4d_core.errors import InputError
from scas4d_core.exports.atomic_files import atomic_path, translate_write_errors
from scas4d_core.exports.track_rows import check_ids_found, evenly_spaced_moving_rows
from scas4d_core.gaussians import Gaussians, moving_extent
from scas4d_core.query.view import ViewRenderer
from scas4d_core.query.visibility import visible_points

JPEG_QUALITY = 95
"""Quality of the images, as in the benchmark."""
QUERY_SEED = 0
"""Seed for the frame and view of each query."""
PIXEL_CENTRE = 0.5
"""Position of the centre of the first pixel in this project; see the module's docstring for that of the dataset."""
COMPRESSION = 1
"""Compression level. Higher levels are slower, but hardly make depth smaller, whose last bits are noise."""


@dataclass
class _View:
    """What has been written for one camera.

    Attributes:
        camera: camera in the user's world.
        folder: temporary folder with the JPEG files and depths, each of which are concatenated in one file.
        sizes: [T] size of each JPEG file in bytes.
        visible: [T] visibility [N] of the tracks in each frame.
    """

    camera: Camera
    folder: Path
    sizes: list[int] = field(default_factory=list)
    visible: list[NDArray[np.bool_]] = field(default_factory=list)


class TapVidMvSequence:
    """Writer of a ``.zip`` in the layout of TAPVid-MV.

    Images and depths are written to a temporary folder next to the file, one frame at a time. The ``.zip`` is written
    by ``finish``. The rasterizer's near plane is that of ``scene.near=auto``.

    Args:
        path: path of the file.
        world: transform from the user's world to the internal world.
        rig: cameras in the user's world.
        ids: ids of the Gaussians whose centres are the tracks, which are written in ascending order. If None, those
            of ``evenly_spaced_moving_rows`` are written.
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
        self._found = np.zeros(0, np.bool_)
        self._extent = 0.0
        self._limits = rig_limits("auto", world, rig.cameras)
        self._renderer = ViewRenderer(world, self._limits)
        self._tracks: list[NDArray[np.float64]] = []
        self._frames: list[int] = []
        self._times: list[float] = []
        with translate_write_errors(self.path):
            self._temporary = tempfile.TemporaryDirectory(prefix=".part-", dir=self.path.parent)
        self._views = [_View(camera, Path(self._temporary.name) / str(k)) for k, camera in enumerate(rig.cameras)]

    def add(self, index: int, time: float, gaussians: Gaussians) -> None:
        """Adds a frame, given its index, its time in seconds, and its state in the internal world.

        Raises:
            InputError: if no Gaussian of the first frame moves and no ids are given, or the disk is full.
        """
        if not self._tracks:
            self._extent = moving_extent(gaussians)
            if self._ids is None:
                self._ids = gaussians.ids[evenly_spaced_moving_rows(gaussians)]
                if not len(self._ids):
                    raise InputError(
                        f"nothing moves in frame {index}, but ids is None", "start at a later frame, or pass ids"
                    )
            self._found = np.zeros(len(self._ids), np.bool_)
        assert self._ids is not None
        positions = np.full((len(self._ids), 3), np.nan)
        _, columns, rows = np.intersect1d(self._ids, gaussians.ids, return_indices=True)
        self._found[columns] = True
        present = gaussians.present[rows]
        positions[columns[present]] = self._world.to_user(gaussians.means[rows[present]])
        self._tracks.append(positions)
        self._frames.append(index)
        self._times.append(time)
        with translate_write_errors(self.path):
            for view in self._views:
                self._add_view(view, gaussians, positions)

    def _add_view(self, view: _View, gaussians: Gaussians, positions: NDArray[np.float64]) -> None:
        rendered = self._renderer.render(gaussians, view.camera, self._background)
        encoded = io.BytesIO()
        Image.fromarray(levels(rendered.colour)).save(encoded, "JPEG", quality=JPEG_QUALITY)
        depth = np.nan_to_num(rendered.depth * np.float32(self._world.metres_per_unit), nan=0.0)
        view.sizes.append(encoded.tell())
        view.visible.append(visible_points(gaussians, self._world, positions, view.camera, self._extent, self._limits))
        view.folder.mkdir(exist_ok=True)
        for name, content in (("jpeg", encoded.getvalue()), ("depth", depth.astype("<f4").tobytes())):
            with (view.folder / name).open("ab") as file:
                file.write(content)

    def finish(self) -> None:
        """Writes the ``.zip`` atomically, one camera at a time.

        Raises:
            InputError: if no track is ever visible, an id is in no frame, or the file cannot be written.
        """
        try:
            with (
                atomic_path(self.path) as beside,
                zipfile.ZipFile(beside, "w", zipfile.ZIP_DEFLATED, compresslevel=COMPRESSION) as archive,
            ):
                self._write(archive)
        finally:
            self.discard()

    def discard(self) -> None:
        """Removes the temporary files."""
        self._temporary.cleanup()

    def _write(self, archive: zipfile.ZipFile) -> None:
        tracks, count = np.stack(self._tracks), len(self._tracks)
        visible = np.stack([np.stack(view.visible) for view in self._views], axis=-1)  # [T, N, views]
        assert self._ids is not None
        check_ids_found(self._ids, self._found)
        kept = visible.any(axis=(0, 2))
        if not kept.any():
            raise InputError("no camera ever sees any of the tracks", "use other frames or ids")
        tracks, visible = tracks[:, kept], visible[:, kept]
        names = {
            "cameras": [view.camera.name for view in self._views],
            "frames": self._frames,
            "times": self._times,
            "ids": self._ids[kept].tolist(),
        }
        archive.writestr("scas4d.json", json.dumps(names))
        metres = self._world.metres_per_unit
        _save(archive, "tracks_xyz.npy", (metres * tracks).astype(np.float32))
        _save(archive, "queries_xytv.npy", _queries(tracks, visible, [view.camera for view in self._views]))
        for k, view in enumerate(self._views):
            camera, pose = view.camera, view.camera.world_to_camera.copy()
            pose[:3, 3] *= metres
            intrinsics = np.array(
                [camera.fx, camera.fy, camera.cx - PIXEL_CENTRE, camera.cy - PIXEL_CENTRE], np.float32
            )
            poses = np.repeat(pose[None].astype(np.float32), count, axis=0)
            depth = np.memmap(view.folder / "depth", "<f4", "r", shape=(count, camera.height, camera.width))
            files = np.empty(count, dtype=object)
            with (view.folder / "jpeg").open("rb") as encoded:
                files[:] = [np.frombuffer(encoded.read(size), np.uint8) for size in view.sizes]
            _save(archive, f"{k}/intrinsics.npy", intrinsics)
            _save(archive, f"{k}/extrinsics_w2c.npy", poses)
            _save(archive, f"{k}/visibility.npy", visible[..., k])
            _save(archive, f"{k}/depth.npy", depth)
            _save(archive, f"{k}/images_jpeg_bytes.npy", files)


def _queries(tracks: NDArray[np.float64], visible: NDArray[np.bool_], cameras: list[Camera]) -> NDArray[np.float32]:
    """Draws the query [N, 4] of each track: u, v, frame and view. Each track must be visible in some frame and view."""
    draw = np.random.default_rng(QUERY_SEED)
    queries = np.empty((tracks.shape[1], 4), np.float32)
    for n in range(tracks.shape[1]):
        choices = np.argwhere(visible[:, n])
        t, view = choices[draw.integers(len(choices))]
        (u, v), _ = cameras[view].project(tracks[t, n])
        queries[n] = u - PIXEL_CENTRE, v - PIXEL_CENTRE, t, view
    return queries


def _save(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    """Adds an array to the archive in the ``.npy`` format."""
    with archive.open(name, "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array)
