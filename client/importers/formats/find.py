"""Finds the calibration in a capture folder, and reads it with the reader of its format."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from client.importers.calibration import Calibration
from client.importers.formats.anipose import is_anipose, read_anipose
from client.importers.formats.caliscope import is_caliscope, read_caliscope
from client.importers.formats.colmap import FOLDERS as COLMAP_FOLDERS
from client.importers.formats.colmap import find_models, is_model, read_largest
from client.importers.formats.documents import json_value, read_xml
from client.importers.formats.easymocap import EXTRINSICS, INTRINSICS, is_easymocap, read_easymocap
from client.importers.formats.kalibr import is_kalibr, read_kalibr
from client.importers.formats.llff import FILE as LLFF
from client.importers.formats.llff import read_llff
from client.importers.formats.meshroom import is_meshroom, read_meshroom
from client.importers.formats.metashape import is_metashape, read_metashape
from client.importers.formats.nerfstudio import FILE, find_transforms, is_transforms, read_transforms
from client.importers.formats.opencv_files import ENDS, camera_files, read_opencv_files
from client.importers.formats.opensfm import is_opensfm, read_opensfm
from client.importers.formats.panoptic import is_panoptic, read_panoptic
from client.importers.formats.qualisys import END as QUALISYS
from client.importers.formats.qualisys import read_qualisys
from scas4d_core.captures import CaptureError
from scas4d_core.captures.dynamic3dgs import TRAIN_META
from scas4d_core.captures.files import read_json_value, read_text

FOLDERS = (".", "calibration")
"""Subfolders of a capture that are searched for calibrations."""
CALISCOPE = "camera_array.toml"

Reader = Callable[[Path, Path], Calibration]
"""Reads a calibration file. The second argument is the capture folder, whose images supply what the file omits."""


@dataclass(frozen=True)
class Format:
    """A format of calibration files.

    Attributes:
        files: files of the format, for messages.
        matches: returns whether a file has this format.
        read: reads a file of this format.
    """

    files: str
    matches: Callable[[Path], bool]
    read: Reader


def _is_toml(path: Path) -> bool:
    """Returns whether the file is calibration.toml, Calib*.toml, or FreeMoCap's <recording>_camera_calibration.toml."""
    name = path.name.lower()
    return name.endswith("_calibration.toml") or (name.startswith("calib") and name.endswith(".toml"))


def _json_is(test: Callable[[Any], bool], *suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.suffix.lower() in suffixes and test(json_value(path, '"cameras"', '"views"', '"shots"'))


def _is_metashape_file(path: Path) -> bool:
    if path.suffix.lower() != ".xml":
        return False
    try:
        return is_metashape(read_xml(path))
    except CaptureError:
        return False


def _read_toml(path: Path, _: Path) -> Calibration:
    try:
        document: dict[str, Any] = tomllib.loads(read_text(path))
    except (ValueError, RecursionError) as fault:  # numbers of thousands of digits are a ValueError
        raise CaptureError(f"{path} cannot be read as TOML: {fault}") from fault
    if is_caliscope(document):
        return read_caliscope(path, document)
    if is_anipose(document):
        return read_anipose(path, document)
    raise CaptureError(f"{path} contains no camera tables with a matrix, as in {CALISCOPE} or anipose's files")


def _of_file(read: Callable[[Path], Calibration]) -> Reader:
    return lambda path, _: read(path)


FORMATS = (
    Format(f"caliscope's {CALISCOPE}", lambda path: path.name == CALISCOPE, _read_toml),
    Format("anipose's calibration.toml, FreeMoCap's *_calibration.toml, Pose2Sim's Calib*.toml", _is_toml, _read_toml),
    Format(f"Qualisys' *{QUALISYS}", lambda path: path.name.lower().endswith(QUALISYS), _of_file(read_qualisys)),
    Format(f"{LLFF} (LLFF, N3DV, Meet Room)", lambda path: path.name == LLFF, read_llff),
    Format("CMU Panoptic's calibration_*.json", _json_is(is_panoptic, ".json"), _of_file(read_panoptic)),
    Format("Metashape's cameras (*.xml)", _is_metashape_file, _of_file(read_metashape)),
    Format("OpenSfM's reconstruction.json", _json_is(is_opensfm, ".json"), _of_file(read_opensfm)),
    Format("Meshroom's cameras.sfm or sfm.json", _json_is(is_meshroom, ".sfm", ".json"), _of_file(read_meshroom)),
    Format("Kalibr's camchain.yaml", is_kalibr, _of_file(read_kalibr)),
)
KNOWN = ", ".join(
    (
        f"{TRAIN_META} (Dynamic3DGaussians)",
        f"{FILE} or transforms_train.json (nerfstudio, instant-ngp)",
        f"cameras.bin or cameras.txt (COLMAP) in {', '.join(COLMAP_FOLDERS)}",
        *(one.files for one in FORMATS),
        f"EasyMocap's {INTRINSICS} with {EXTRINSICS}",
        f"OpenCV's or ROS's <camera>{ENDS[0]}, .xml or .json",
    )
)
"""Known layouts, for messages."""
UNREAD = {
    ".xcp": "a Vicon calibration, which is not read, because Vicon does not document its lens distortion and image "
    "axes; convert it to Calib.toml with Pose2Sim, and check the result",
    ".csv": "possibly RealityCapture camera parameters, which are not read, because the scale of px and py and the "
    "distortion are not documented; export a COLMAP model from RealityCapture or RealityScan instead",
    ".abc": "an Alembic scene; export JSON from Meshroom (ConvertSfMFormat) instead",
}
"""Why files of tools of this field are not read, keyed by extension."""


def read_calibration(folder: Path, given: Path | None = None) -> Calibration:
    """Reads the given calibration, or searches the folder for one.

    The search order is transforms.json or its split files, a COLMAP model in one of the usual places, then a single
    file of another tool.

    Raises:
        CaptureError: if there is no calibration, there are several, or the calibration cannot be read.
        MissingExtraError: if the format needs a package from the extra `importers`.
    """
    if given is not None:
        return _read_given(folder, given)
    others = find_calibrations(folder)
    transforms = find_transforms(folder)
    if transforms:
        return _with_unread_remark(others, folder, read_transforms(transforms, folder))
    models = find_models(folder)
    if models:
        return _with_unread_remark(others, folder, read_largest(models))
    if others:
        return read_calibration_file(single_calibration(others, folder), folder)
    raise CaptureError(
        f"{folder}: unknown capture layout{_other_files(folder)}; known layouts, here or in calibration/: {KNOWN}; "
        "if the calibration is elsewhere, choose it with --calibration"
    )


def _read_given(folder: Path, given: Path) -> Calibration:
    if not given.exists():
        raise CaptureError(f"{given}: no such file or folder (--calibration)")
    if given.is_file() and is_transforms(given):
        return read_transforms([given], folder)
    if given.is_dir():
        transforms = find_transforms(given)
        if transforms:
            return read_transforms(transforms, folder)
        models = find_models(given) or [path for path in sorted(given.iterdir()) if is_model(path)]
        if models:
            return read_largest(models)
    return read_calibration_file(given, folder)


def _other_files(folder: Path) -> str:
    """Returns what the folder contains instead of a known calibration, or what is damaged, for a message."""
    names = [path for place in FOLDERS if (folder / place).is_dir() for path in sorted((folder / place).iterdir())]
    for path in names:
        if path.is_file() and path.suffix.lower() in UNREAD:
            return f": {path.relative_to(folder)} is {UNREAD[path.suffix.lower()]}"
        if path.is_file() and path.suffix.lower() in (".xml", ".json", ".sfm"):
            try:
                read_xml(path) if path.suffix.lower() == ".xml" else read_json_value(path)
            except CaptureError as fault:
                return f": {fault}"
    files = [path.name for path in names if path.is_file() and not path.name.startswith(".")]
    return f": none of its files is a known calibration ({', '.join(files[:5])})" if files else ": it contains no files"


def _with_unread_remark(others: list[Path], folder: Path, read: Calibration) -> Calibration:
    """Returns the calibration with a remark that lists the other calibrations in the folder, which are not read."""
    if not others:
        return read
    listed = ", ".join(str(path.relative_to(folder)) for path in others)
    remark = (
        f"using calibration {read.source.relative_to(folder)}, not {listed}; choose another with --calibration FILE"
    )
    return replace(read, remarks=(*read.remarks, remark))


def find_calibrations(capture: Path) -> list[Path]:
    """Returns the paths of the calibrations of `FORMATS`, EasyMocap and OpenCV in a capture folder.

    They are files, or folders whose files form one calibration.
    """
    return [path for name in FOLDERS for path in _calibrations_in(capture / name)]


def _calibrations_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    names = sorted(path for path in folder.iterdir() if path.is_file())
    files = [path for path in names if any(one.matches(path) for one in FORMATS)]
    if is_easymocap(folder):
        files.append(folder / INTRINSICS)
    elif camera_files(folder):
        files.append(folder)
    return files


def read_calibration_file(path: Path, capture: Path) -> Calibration:
    """Reads a calibration file, or the only calibration in a folder.

    Args:
        path: calibration file, or folder that contains exactly one calibration.
        capture: capture folder, whose images supply what the file omits.

    Raises:
        CaptureError: if the format is unknown, the folder has several calibrations, or the file cannot be read.
        MissingExtraError: if the format needs a package from the extra `importers`.
    """
    if path.is_dir():
        here = _calibrations_in(path)
        if here == [path]:
            return read_opencv_files(path, capture)
        return read_calibration_file(single_calibration(here, path), capture)
    if path.suffix.lower() == ".toml":
        return _read_toml(path, capture)
    if path.name in (INTRINSICS, EXTRINSICS):
        return read_easymocap(path.parent, capture)
    reader = next((one.read for one in FORMATS if one.matches(path)), None)
    if reader is not None:
        return reader(path, capture)
    if path in camera_files(path.parent):
        return read_opencv_files(path.parent, capture)
    why = f": it is {UNREAD[path.suffix.lower()]}" if path.suffix.lower() in UNREAD else ""
    raise CaptureError(f"{path} is no calibration in a known format{why}; known formats: {KNOWN}")


def single_calibration(found: list[Path], folder: Path) -> Path:
    """Returns the only calibration found.

    Raises:
        CaptureError: if there are no calibrations, or several.
    """
    if len(found) == 1:
        return found[0]
    if not found:
        raise CaptureError(f"{folder} contains no calibration in a known format; known formats: {KNOWN}")
    listed = ", ".join(str(path.relative_to(folder)) for path in found)
    raise CaptureError(
        f"{folder} contains {len(found)} calibrations ({listed}); choose one with --calibration {found[0]}, or keep "
        "only one"
    )
