"""Reads captures in the data layout of Dynamic3DGaussians.

This module requires only NumPy and Pillow.

In the following, t is the index of a frame and c is the index of a camera.
``train_meta.json`` and ``test_meta.json`` contain ``w``, ``h``, ``k[t][c]`` (3×3, pixels),
``w2c[t][c]`` (4×4, OpenCV axes), ``fn[t][c]`` (path under ``ims/``) and ``cam_id[t][c]``. Masks are
in ``seg/`` under the same paths, with the suffix ``.png``. ``init_pt_cld.npz`` contains ``data``
[P, 7]: x y z, r g b ([0, 1]), foreground ([0, 1]).

This reader also accepts three extensions: ``fps`` in ``train_meta.json``, one value per camera for
``w`` and ``h``, and point clouds with six columns (without foreground).

Reference: ``train.py`` in JonathonLuiten/Dynamic3DGaussians.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import CAMERA_NAME, Camera, CameraError, Rig, minimum_cameras
from scas4d_core.captures.capture import Capture
from scas4d_core.captures.files import CaptureError, read_json, read_npz
from scas4d_core.captures.frame import InitialPoints
from scas4d_core.captures.ground_truth import read_extent, read_ground_truth
from scas4d_core.captures.images import describe_pictures, scaled_size, usual_size
from scas4d_core.captures.picture_file import ImageError
from scas4d_core.captures.reader import FileReader, Files
from scas4d_core.captures.size_mismatch import SizeMismatch, adapt_intrinsics

TRAIN_META = "train_meta.json"
STATIC_TOLERANCE = 1e-6
"""Maximum relative change over time of any entry of k or w2c for which a camera counts as static."""


def read_dynamic3dgs(
    folder: Path | str,
    *,
    image_scale: float = 1.0,
    fps: float | None = None,
    use_masks: bool = True,
    use_points: bool = True,
    size_mismatch: SizeMismatch | None = None,
    bit_depth: int | None = None,
) -> Capture:
    """Opens a capture in the Dynamic3DGaussians layout.

    The name of a camera is ``str(cam_id)``. ``test_meta.json`` lists the test cameras. Masks, point
    cloud, test cameras and ground truth are optional. If masks are read and the folder ``seg/``
    exists, it must contain a mask for every training image.

    Args:
        folder: folder that contains ``train_meta.json``.
        image_scale: factor by which images, masks, labels and cameras are scaled.
        fps: frames per second, or None to use ``fps`` from ``train_meta.json`` (written by
            ``scas4d import``), or 30 if the file has no such entry.
        use_masks: whether to read the masks in ``seg/``.
        use_points: whether to read ``init_pt_cld.npz``.
        size_mismatch: how images with an aspect ratio other than ``w``:``h`` were produced (see
            `adapt_intrinsics`), or None to reject such images.
        bit_depth: number of bits that the values of 16-bit images use; None to find it from the values.

    Raises:
        CaptureError: if a file is missing, damaged or inconsistent with other files, or if a camera
            moves.
    """
    folder = Path(folder)
    train = _read_cameras(folder, TRAIN_META, size_mismatch)
    rate = train.fps if fps is None else fps
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not (np.isfinite(rate) and rate > 0):
        raise CaptureError(f"{folder}: fps must be a positive number of frames per second; got {rate!r}")
    test = _read_cameras(folder, "test_meta.json", size_mismatch) if (folder / "test_meta.json").exists() else None
    if test is not None:
        both = sorted(set(train.rig.names) & set(test.rig.names))
        if both:
            raise CaptureError(f"{folder / 'test_meta.json'}: cam_id {', '.join(both)} is also used in {TRAIN_META}")
        if len(test.images) != len(train.images):
            raise CaptureError(
                f"{folder / 'test_meta.json'} has {len(test.images)} frames, but {TRAIN_META} has {len(train.images)}"
            )
    given = [train] if test is None else [train, test]
    sizes = {camera.name: (camera.width, camera.height) for one in given for camera in one.rig.cameras}
    scaled = {name: (size, scaled_size(size, image_scale)) for name, size in sizes.items()}
    masks: list[tuple[Files, ...]] = [({},) * len(train.images)]
    if use_masks and (folder / "seg").is_dir():
        masks = [_masks(folder, one, required=one is train) for one in given]
    images = _merge_files([one.images for one in given])
    try:
        usual = {name: file for one in given for name, file in one.usual.items()}
        depth, described = describe_pictures(usual, images, bit_depth)
    except ImageError as fault:
        raise CaptureError(str(fault)) from fault
    return Capture(
        name=folder.resolve().name,
        full_rig=train.rig,
        full_test_rig=test.rig if test else None,
        pictures=FileReader(images, _merge_files(masks), sizes, depth),
        image_scale=image_scale,
        fps=float(rate),
        points=_read_points(folder / "init_pt_cld.npz") if use_points else None,
        ground_truth=read_ground_truth(folder, len(train.images), scaled),
        extent=read_extent(folder),
        remarks=(*(remark for one in given for remark in one.remarks), *described),
    )


def _merge_files(of: list[tuple[Files, ...]]) -> list[Files]:
    """Merges the files of training and test cameras into one mapping per frame."""
    return [{name: file for files in frame for name, file in files.items()} for frame in zip(*of, strict=True)]


@dataclass(frozen=True, eq=False)
class _Cameras:
    rig: Rig
    images: tuple[Files, ...]
    relative: tuple[dict[str, PurePosixPath], ...]
    fps: Any
    usual: Files
    remarks: list[str]


def _read_cameras(folder: Path, file: str, size_mismatch: SizeMismatch | None) -> _Cameras:
    path = folder / file
    meta = read_json(path)
    missing = [key for key in ("w", "h", "k", "w2c", "fn", "cam_id") if key not in meta]
    if missing:
        raise CaptureError(f"{path}: missing {', '.join(missing)}")
    names = _camera_names(path, meta["cam_id"])
    widths, heights = (_sizes(path, key, meta[key], len(names)) for key in ("w", "h"))
    intrinsics = _require_static(path, "k", meta["k"], (len(meta["cam_id"]), len(names), 3, 3))
    poses = _require_static(path, "w2c", meta["w2c"], (len(meta["cam_id"]), len(names), 4, 4))
    try:
        rig = Rig(tuple(map(Camera, names, intrinsics, poses, widths, heights)))
    except CameraError as fault:
        raise CaptureError(f"{path}: {fault}") from fault
    relative = _relative_paths(path, meta["fn"], len(meta["cam_id"]), names)
    images = tuple({name: folder / "ims" / file for name, file in frame.items()} for frame in relative)
    least = minimum_cameras(len(names))
    if all(sum(file.is_file() for file in frame.values()) < least for frame in images):
        absent = next(file for file in images[0].values() if not file.is_file())
        raise CaptureError(f"{absent}: no such file (listed in {file})")
    cameras, usual, remarks, faults = [], dict[str, Path](), [], []
    for camera in rig.cameras:
        calibrated = (camera.width, camera.height)
        try:
            usual[camera.name], size = usual_size((of[camera.name] for of in images), calibrated)
        except ImageError as error:  # the camera is left out of every frame
            faults.append(error)
            cameras.append(camera)
            continue
        k, remark = adapt_intrinsics(
            camera.intrinsics,
            calibrated,
            size,
            camera=camera.name,
            where=str(usual[camera.name]),
            size_mismatch=size_mismatch,
        )
        cameras.append(replace(camera, intrinsics=k, width=size[0], height=size[1]))
        remarks += [] if remark is None else [remark]
    if len(usual) < least:
        raise CaptureError(str(faults[0])) from faults[0]
    return _Cameras(Rig(tuple(cameras)), images, relative, meta.get("fps", 30.0), usual, remarks)


def _sizes(path: Path, key: str, value: Any, cameras: int) -> list[int]:
    """Returns the width or height of each camera; a single number applies to all cameras."""
    if not isinstance(value, list):
        return [_parse_pixels(path, key, value)] * cameras
    if len(value) != cameras:
        raise CaptureError(f"{path}: {key} has {len(value)} values, but cam_id lists {cameras} cameras")
    return [_parse_pixels(path, f"{key}[{number}]", one) for number, one in enumerate(value)]


def _parse_pixels(path: Path, key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float) or value != round(value) or value < 1:
        raise CaptureError(f"{path}: {key} must be a positive whole number of pixels; got {value!r}")
    return int(value)


def _camera_names(path: Path, cam_id: Any) -> list[str]:
    if not isinstance(cam_id, list) or not cam_id or not all(isinstance(row, list) and row for row in cam_id):
        raise CaptureError(f"{path}: cam_id must be a non-empty list with a non-empty list of cameras per frame")
    changed = next((t for t, row in enumerate(cam_id) if row != cam_id[0]), None)
    if changed is not None:
        raise CaptureError(
            f"{path}: cam_id of frame {changed} differs from that of frame 0; list the same cameras in every frame"
        )
    names = [str(name) for name in cam_id[0]]
    for name in names:
        if not re.fullmatch(CAMERA_NAME, name):
            raise CaptureError(
                f"{path}: cam_id {name!r} cannot be used in file names; use a number, or at most 64 letters, digits, "
                "dots, dashes and underscores"
            )
    return names


def _require_static(path: Path, key: str, value: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as fault:
        raise CaptureError(
            f"{path}: {key} must be numeric with shape {list(shape)} to match cam_id: {fault}"
        ) from fault
    if array.shape != shape:
        raise CaptureError(f"{path}: {key} must have shape {list(shape)} to match cam_id; got {list(array.shape)}")
    moved = np.abs(array - array[:1]).max(axis=(2, 3)) > STATIC_TOLERANCE * np.maximum(1, np.abs(array[:1])).max()
    if moved.any():
        frame, camera = np.argwhere(moved)[0]
        raise CaptureError(
            f"{path}: {key} of camera number {camera} changes at frame {frame}, but cameras must not move; "
            "split the capture at this frame"
        )
    still: NDArray[np.float64] = array[0]
    return still


def _relative_paths(path: Path, fn: Any, frames: int, names: list[str]) -> tuple[dict[str, PurePosixPath], ...]:
    if not isinstance(fn, list) or len(fn) != frames:
        raise CaptureError(f"{path}: fn must list {frames} frames to match cam_id")
    result = []
    for number, row in enumerate(fn):
        if not isinstance(row, list) or len(row) != len(names) or not all(isinstance(entry, str) for entry in row):
            raise CaptureError(f"{path}: fn[{number}] must list {len(names)} file names to match cam_id")
        files = {}
        for name, entry in zip(names, row, strict=True):
            file = PurePosixPath(entry)
            if file.is_absolute() or ".." in file.parts or "\\" in entry or not file.name:
                raise CaptureError(f"{path}: fn[{number}] {entry!r} points outside ims/; use a path under ims/")
            files[name] = file
        result.append(files)
    return tuple(result)


def _masks(folder: Path, cameras: _Cameras, *, required: bool) -> tuple[Files, ...]:
    frames = []
    for relative, images in zip(cameras.relative, cameras.images, strict=True):
        files = {name: folder / "seg" / file.with_suffix(".png") for name, file in relative.items()}
        absent = [name for name, file in files.items() if not file.is_file()]
        without = [name for name in absent if images[name].is_file()]
        if without and required:
            raise CaptureError(
                f"{files[without[0]]}: no mask for camera {without[0]}; provide masks for all training cameras and "
                "frames, or ignore all masks (use_masks=False)"
            )
        frames.append({name: file for name, file in files.items() if name not in absent})
    return tuple(frames)


def _read_points(path: Path) -> InitialPoints | None:
    if not path.exists():
        return None
    data = read_npz(path, ("data",))["data"]
    if data.ndim != 2 or data.shape[1] not in (6, 7) or len(data) == 0 or data.dtype.kind not in "fiu":
        raise CaptureError(
            f"{path}: data must be a numeric array of shape [P, 7] (x, y, z, r, g, b, foreground) or [P, 6] (without "
            f"foreground); got {data.dtype} {list(data.shape)}"
        )
    if not np.isfinite(data).all():
        raise CaptureError(
            f"{path}: data contains NaN or infinity in row {int(np.argmin(np.isfinite(data).all(axis=1)))}"
        )
    shown = data[:, 3:]
    if shown.min() < -1e-3 or shown.max() > 1 + 1e-3:
        raise CaptureError(
            f"{path}: colours and foreground must be in [0, 1], but are in [{shown.min():g}, {shown.max():g}]; "
            "divide 8-bit values by 255"
        )
    shown = np.clip(shown, 0, 1).astype(np.float32)
    foreground = shown[:, 3] if shown.shape[1] == 4 else None
    return InitialPoints(data[:, :3].astype(np.float64), shown[:, :3], foreground)
