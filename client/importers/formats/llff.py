"""Reads `poses_bounds.npy`, the layout of LLFF and of the data sets N3DV (Neural 3D Video) and Meet Room.

The array [N, 17] has a row per camera: a matrix [3, 5] and two depth bounds, which are not read. The first four columns
are the camera-to-world pose with the axes x down, y right, z back, and the fifth is (height, width, focal length) in
pixels. The principal point is the image centre, and there is no distortion. Rows contain no names. They are in the
order of the sorted file names of the images or videos, so the numbers of rows and of cameras must be equal.
(github.com/Fyusion/LLFF, README "Using your own poses without running COLMAP";
github.com/facebookresearch/Neural_3D_Video.)
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import (
    CalibratedImage,
    Calibration,
    calibration,
    calibration_of_cameras,
    listed,
    natural,
)
from client.importers.folders import IMAGES, picture_sources, pictures_in
from client.importers.lens import LensCamera, lens_camera
from scas4d_core.captures import CaptureError

FILE = "poses_bounds.npy"
COLUMNS = 17


def read_llff(path: Path, capture: Path) -> Calibration:
    """Reads the rig from a `poses_bounds.npy`.

    Args:
        path: the file.
        capture: folder with the images or videos, which name the cameras.

    Raises:
        CaptureError: if the file is invalid, or the number of cameras in the folder differs from the number of rows.
    """
    rows = _rows(path)
    counts = []
    for source in picture_sources(capture):
        if len(source.entries) == len(rows):
            names = sorted(source.entries, key=lambda name: source.entries[name][0].name)
            return _of_names(path, rows, names)
        counts.append(f"{len(source.entries)} {source.kind} in {source.root}")
    for place in IMAGES:
        pictures = pictures_in(capture / place)
        if len(pictures) == len(rows):
            files = sorted(pictures, key=lambda file: file.name)
            views = [
                CalibratedImage(
                    PurePosixPath(file.relative_to(capture).as_posix()), _camera(path, row, index, file.stem)
                )
                for index, (file, row) in enumerate(zip(files, rows, strict=True))
            ]
            return calibration(path, views)
        counts += [f"{len(pictures)} images in {capture / place}"] if pictures else []
    raise CaptureError(
        f"{path} has {len(rows)} rows, one per camera, but there are {', '.join(counts) or 'no images or videos'}; the "
        "rows belong to the sorted images or videos: add the missing ones, or remove the rows of missing cameras"
    )


def _of_names(path: Path, rows: NDArray[np.float64], names: list[str]) -> Calibration:
    cameras = [_camera(path, row, index, name) for index, (row, name) in enumerate(zip(rows, names, strict=True))]
    remark = f"{path.name}: its rows are assigned to the cameras in alphabetical order: {listed(names)}"
    return calibration_of_cameras(path, cameras, remarks=[remark] if names != sorted(names, key=natural) else [])


def _rows(path: Path) -> NDArray[np.float64]:
    try:
        with path.open("rb") as file:
            rows = np.asarray(np.load(file, allow_pickle=False), np.float64)
    except Exception as fault:  # NumPy raises different exceptions, such as MemoryError for a damaged shape
        raise CaptureError(f"{path} cannot be read as a NumPy array of numbers: {fault}; copy it again") from fault
    if rows.ndim != 2 or rows.shape[1] != COLUMNS or not len(rows):
        raise CaptureError(f"{path} must be an array [cameras, {COLUMNS}]; got shape {list(rows.shape)}")
    return rows


def _camera(path: Path, row: NDArray[np.float64], index: int, name: str) -> LensCamera:
    where = f"{path}: row {index} (camera {name!r})"
    matrix = row[:15].reshape(3, 5)
    height, width, focal = matrix[:, 4]
    if (
        not np.isfinite(matrix).all()
        or min(height, width) < 1
        or not np.allclose([height, width], np.round([height, width]))
    ):
        raise CaptureError(
            f"{where} must contain a pose and height, width, focal length; got {matrix.ravel().tolist()}"
        )
    down, right, back, place = matrix[:, :4].T
    rotation = np.stack([right, down, -back])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ place
    parameters = {"f": focal, "cx": width / 2, "cy": height / 2}
    return lens_camera(name, "SIMPLE_PINHOLE", parameters, pose, (round(width), round(height)), source=where)
