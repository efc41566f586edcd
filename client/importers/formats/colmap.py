"""Reads COLMAP models in text or binary format: `cameras`, `images` and, if present, `points3D`. Requires only numpy.

Poses are world-to-camera transforms with OpenCV axes, stored as a quaternion (w, x, y, z) and a translation. Principal
points are relative to the upper left corner of the image. This project uses the same conventions.
(colmap.github.io/format.html; `src/colmap/scene/reconstruction_io.cc`.)

This module does not use pycolmap (135 MB). `Reconstruction.read` of pycolmap 4.2.1 requires `points3D`, and skips
images if a tool omitted the lines with their points. It accepts invalid poses and does not name damaged files. If a
damaged file announces 2⁶³ points, it does not return within a minute.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.importers.calibration import CalibratedImage, Calibration, calibration, natural
from client.importers.lens import MODELS, LensCamera, lens_camera
from scas4d_core.captures import CaptureError, InitialPoints
from scas4d_core.captures.files import read_text

Float = NDArray[np.float64]

MODEL_IDS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
}
LONGEST_NAME = 4096
FOLDERS = ("sparse", ".", "colmap/sparse", "colmap", "calibration")
"""Places in a capture folder that are searched for models. `sparse` may contain several: `0`, `1`, …"""


@dataclass(frozen=True)
class _Camera:
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]


def is_model(folder: Path) -> bool:
    """Returns whether the folder contains a COLMAP model."""
    # Unlike Path.is_file, os.path.isfile returns False in folders that must not be searched, such as `lost+found`.
    return any(os.path.isfile(folder / f"cameras{end}") for end in (".bin", ".txt"))


def find_models(capture: Path) -> list[Path]:
    """Returns the models in the first of the usual places that contains any, in natural order."""
    for place in FOLDERS:
        folder = capture / place
        inner = sorted(folder.iterdir(), key=lambda path: natural(path.name)) if folder.is_dir() else []
        models = [path for path in inner if folder.name == "sparse" and is_model(path)]
        models += [folder] if is_model(folder) else []
        if models:
            return models
    return []


def read_largest(models: list[Path]) -> Calibration:
    """Reads the model with the most images. If there are several models, a remark lists all of them.

    COLMAP writes a model for each group of images that it cannot connect with the others.

    Raises:
        CaptureError: if a model cannot be read.
    """
    if len(models) == 1:
        return read_colmap(models[0])
    counts = {model: _image_count(model) for model in models}
    largest = max(models, key=lambda model: counts[model])
    sizes = ", ".join(f"{model.parent.name}/{model.name} with {count} images" for model, count in counts.items())
    remark = (
        f"found {len(models)} COLMAP models ({sizes}); using {largest.parent.name}/{largest.name}, which has the most "
        "images; choose another with --calibration"
    )
    read = read_colmap(largest)
    return replace(read, remarks=(remark, *read.remarks))


def _image_count(folder: Path) -> int:
    if (folder / "cameras.bin").is_file():
        return int(_Bytes(folder / "images.bin").take("Q", "the number of images")[0])
    return sum(1 for _ in _text_images(folder / "images.txt"))


def read_colmap(folder: Path) -> Calibration:
    """Reads the rig and the point cloud from a model.

    Raises:
        CaptureError: if a file is missing or malformed, or a camera is invalid. The message names the file and the
            problem.
    """
    end = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    files = {name: folder / f"{name}{end}" for name in ("cameras", "images", "points3D")}
    for name in ("cameras", "images"):
        if not files[name].is_file():
            raise CaptureError(f"{files[name]}: no such file, although {folder} contains other files of a COLMAP model")
    binary = end == ".bin"
    cameras = _binary_cameras(files["cameras"]) if binary else _text_cameras(files["cameras"])
    images = list(_binary_images(files["images"]) if binary else _text_images(files["images"]))
    if not images:
        raise CaptureError(f"{files['images']} lists no images; if COLMAP registered none, calibrate with more overlap")
    points = None
    if files["points3D"].is_file():
        points = _cloud(list(_binary_points(files["points3D"]) if binary else _text_points(files["points3D"])))
    views = [
        CalibratedImage(PurePosixPath(image.name.replace("\\", "/")), _lens(files, cameras, image)) for image in images
    ]
    return calibration(folder, views, points=points)


def _lens(files: dict[str, Path], cameras: dict[int, _Camera], image: _Image) -> LensCamera:
    camera = cameras.get(image.camera)
    if camera is None:
        raise CaptureError(
            f"{files['images']}: image {image.name} refers to camera {image.camera}, which is not in "
            f"{files['cameras'].name}"
        )
    q, t = np.array(image.quaternion), np.array(image.translation)
    length = np.linalg.norm(q)
    if not (np.isfinite(length) and abs(length - 1) < 1e-2 and np.isfinite(t).all()):
        listed = " ".join(f"{value:g}" for value in (*image.quaternion, *image.translation))
        raise CaptureError(
            f"{files['images']}: image {image.name} has an invalid pose ({listed}); q must be a unit quaternion"
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = _rotation(q / length), t
    names = MODELS.get(camera.model, ())
    if names and len(names) != len(camera.parameters):
        raise CaptureError(
            f"{files['cameras']}: camera {image.camera} has {len(camera.parameters)} parameters, but {camera.model} "
            f"requires {len(names)}: {', '.join(names)}"
        )
    parameters = dict(zip(names, camera.parameters, strict=False))
    size = (camera.width, camera.height)
    return lens_camera(image.name, camera.model, parameters, pose, size, source=str(files["cameras"]))


def _rotation(q: Float) -> Float:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _cloud(rows: list[tuple[float, ...]]) -> InitialPoints | None:
    array = np.array(rows, dtype=np.float64).reshape(-1, 6)
    array = array[np.isfinite(array).all(axis=1)]
    if not len(array):
        return None
    return InitialPoints(array[:, :3], np.clip(array[:, 3:] / 255, 0, 1).astype(np.float32))


# Text format.


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(read_text(path).split("\n"), 1):
        if not line.startswith("#"):
            yield number, line.strip()


def _fields(path: Path, number: int, line: str, kinds: str, what: str) -> list[Any]:
    """Parses the fields of a line.

    `kinds` contains one letter per field: `i` for integer, `f` for float, `s` for text. The last letter applies to all
    remaining fields.
    """
    words = line.split(maxsplit=len(kinds) - 1 if kinds.endswith("s") else -1)
    if len(words) < len(kinds):
        raise CaptureError(f"{path}: line {number} has {len(words)} fields; expected: {what}")
    read = {"i": int, "f": float, "s": str}
    try:
        return [read[kinds[min(place, len(kinds) - 1)]](word) for place, word in enumerate(words)]
    except ValueError as fault:
        raise CaptureError(f"{path}: line {number}: {fault}; expected: {what}") from fault


def _text_cameras(path: Path) -> dict[int, _Camera]:
    cameras = {}
    for number, line in _lines(path):
        if line:
            words = line.split(maxsplit=2)
            if len(words) < 3:
                raise CaptureError(f"{path}: line {number} has {len(words)} fields; expected: id MODEL width height …")
            values = _fields(path, number, f"{words[0]} {words[2]}", "iiif", "id MODEL width height parameters")
            cameras[values[0]] = _Camera(words[1], values[1], values[2], tuple(values[3:]))
    return cameras


def _text_images(path: Path) -> Iterator[_Image]:
    # An image may be followed by a line with its points, which may be empty. Some tools omit that line.
    after_image = False
    for number, line in _lines(path):
        if not line or (after_image and _is_points(line)):
            after_image = False
            continue
        values = _fields(path, number, line, "ifffffffis", "id qw qx qy qz tx ty tz camera name")
        yield _Image(values[9], values[8], tuple(values[1:5]), tuple(values[5:8]))
        after_image = True


def _is_points(line: str) -> bool:
    """Returns whether a line of `images.txt` consists of triples (x, y, id of the 3D point or -1)."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(
            int(words[place]) >= -1 if place % 3 == 2 else np.isfinite(float(words[place]))
            for place in range(len(words))
        )
    except ValueError:
        return False


def _text_points(path: Path) -> Iterator[tuple[float, ...]]:
    for number, line in _lines(path):
        if line:
            yield tuple(_fields(path, number, line, "ifffffff", "id x y z r g b error …")[1:7])


# Binary format, little-endian.


class _Bytes:
    """Sequential reader for a binary file. Its errors state where a truncated file ends."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._data = path.read_bytes()
        except OSError as fault:
            raise CaptureError(f"{path} cannot be read: {fault.strerror}") from fault
        self._at = 0

    def take(self, form: str, what: str) -> tuple[Any, ...]:
        size = struct.calcsize("<" + form)
        if self._at + size > len(self._data):
            raise CaptureError(
                f"{self.path} is truncated after {len(self._data)} bytes, within {what}; copy the file again"
            )
        values = struct.unpack_from("<" + form, self._data, self._at)
        self._at += size
        return values

    def skip(self, size: int, what: str) -> None:
        if self._at + size > len(self._data):
            raise CaptureError(
                f"{self.path} is truncated after {len(self._data)} bytes, within {what}; copy the file again"
            )
        self._at += size

    def text(self, what: str) -> str:
        end = self._data.find(b"\0", self._at, self._at + LONGEST_NAME)
        if end < 0:
            raise CaptureError(f"{self.path}: {what} is not terminated; is this a COLMAP {self.path.name}?")
        text = self._data[self._at : end].decode("utf-8", "replace")
        self._at = end + 1
        return text


def _binary_cameras(path: Path) -> dict[int, _Camera]:
    file = _Bytes(path)
    cameras = {}
    (count,) = file.take("Q", "the number of cameras")
    for number in range(count):
        what = f"camera {number + 1} of {count}"
        id, model, width, height = file.take("iiQQ", what)
        name = MODEL_IDS.get(model)
        if name not in MODELS:  # the parameter count is known only for supported models
            raise CaptureError(
                f"{path}: camera {id} has the unsupported model {name or f'number {model}'}; "
                f"calibrate with one of {', '.join(MODELS)}"
            )
        cameras[id] = _Camera(name, width, height, file.take(f"{len(MODELS[name])}d", what))
    return cameras


def _binary_images(path: Path) -> Iterator[_Image]:
    file = _Bytes(path)
    (count,) = file.take("Q", "the number of images")
    for number in range(count):
        what = f"image {number + 1} of {count}"
        _, *pose, camera = file.take("i4d3di", what)
        name = file.text(f"the name of {what}")
        (points,) = file.take("Q", what)
        file.skip(24 * points, what)
        yield _Image(name, camera, tuple(pose[:4]), tuple(pose[4:]))


def _binary_points(path: Path) -> Iterator[tuple[float, ...]]:
    file = _Bytes(path)
    (count,) = file.take("Q", "the number of points")
    for number in range(count):
        what = f"point {number + 1} of {count}"
        _, x, y, z, r, g, b, _ = file.take("Q3d3Bd", what)
        (track,) = file.take("Q", what)
        file.skip(8 * track, what)
        yield x, y, z, r, g, b
