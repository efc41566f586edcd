"""Reads OpenCV FileStorage files (YAML or XML), and the image sizes that such files often omit.

Reading this format requires OpenCV, because no other library parses its `%YAML:1.0` header and `!!opencv-matrix` tags.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from client.importers.extras import load, pyav
from client.importers.pictures import READ
from client.importers.videos import ENDS
from scas4d_core.captures import CaptureError, ImageError
from scas4d_core.captures.images import picture_size

LARGEST_FILE = 16 << 20
TAG = re.compile(rb"</?[A-Za-z_]")
LEVELS = np.zeros(256, np.int8)
LEVELS[[ord("["), ord("{")]], LEVELS[[ord("]"), ord("}")]] = 1, -1
DASHES = re.compile(rb" *(?:- )+")
DEEPEST = 32
"""Maximum nesting depth. OpenCV parses recursively and crashes at about ten thousand levels."""


def read_storage(path: Path) -> dict[str, Any]:
    """Returns the top-level fields of a file, keyed by name.

    Values are lists, numbers, strings and matrices, which become arrays [rows, cols]. Anything else becomes None.

    Raises:
        CaptureError: if the file cannot be read.
        MissingExtraError: if OpenCV is not installed.
    """
    cv2 = load("cv2", needed="reading OpenCV's YAML and XML files")
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise CaptureError(f"{path} is larger than {LARGEST_FILE >> 20} MB; this is not a calibration file")
        if _depth(path.read_bytes()) > DEEPEST:
            raise CaptureError(f"{path} is nested more than {DEEPEST} levels deep; this is not a calibration file")
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        if not storage.isOpened():
            raise CaptureError(f"{path} cannot be read as an OpenCV FileStorage file (YAML or XML)")
        root = storage.root()
        return {key: _value(root.getNode(key)) for key in root.keys()}  # noqa: SIM118 - a FileNode is not a mapping
    except (OSError, SystemError, cv2.error) as fault:
        first = str(fault).strip().splitlines()[0] if str(fault).strip() else type(fault).__name__
        raise CaptureError(f"{path} cannot be read as an OpenCV FileStorage file: {first}") from fault


def _depth(data: bytes) -> int:
    """Returns the nesting depth of brackets, indentation (YAML) or tags (XML), whichever is largest."""
    brackets = np.cumsum(LEVELS[np.frombuffer(data, np.uint8)], dtype=np.int64)
    tags = np.cumsum([-1 if tag.startswith(b"</") else 1 for tag in TAG.findall(data)])
    lines = [line for line in data.splitlines() if line.strip()]
    if len(tags):  # indentation has no meaning in XML
        return int(max(brackets.max(), tags.max()))
    dashes = max((len(match[0]) // 2 for match in map(DASHES.match, lines) if match), default=0)
    return int(max(brackets.max(initial=0), len({len(line) - len(line.lstrip()) for line in lines}), dashes))


def _value(node: Any) -> Any:
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_value(node.at(i)) for i in range(node.size())]
    if node.isMap():
        return node.mat()  # None if the map is not a matrix
    return None


def first_field(stored: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """Returns the first of the named fields that has a value, or None."""
    return next((stored[name] for name in names if stored.get(name) is not None), None)


def size_of_pictures(folder: Path, camera: str, where: str) -> tuple[int, int]:
    """Returns (width, height) of the first image in ``images/<camera>/``, or of ``videos/<camera>.mp4``.

    Args:
        folder: capture folder.
        camera: camera name.
        where: name of the file and of the camera that has no size, for error messages.

    Raises:
        CaptureError: if there is neither an image nor a video, or the file cannot be read.
        MissingExtraError: if a video must be read and PyAV is not installed.
    """
    images = folder / "images" / camera
    if images.is_dir():
        for path in sorted(images.iterdir()):
            if path.suffix.lower() in READ and not path.name.startswith("."):
                try:
                    return picture_size(path)
                except ImageError as fault:
                    raise CaptureError(str(fault)) from fault
    for path in (folder / "videos" / f"{camera}{end}" for end in ENDS):
        if path.is_file():
            av = pyav()
            try:
                with av.open(str(path)) as container:
                    context = container.streams.video[0].codec_context
                    return int(context.width), int(context.height)
            except (av.FFmpegError, IndexError) as fault:
                raise CaptureError(f"{path} cannot be read as video: {fault}") from fault
    raise CaptureError(
        f"{where} has no image size, and neither {images}/ nor {folder / 'videos' / camera}.mp4 exists "
        "to read it from; add the images there, or add the size to the file"
    )
