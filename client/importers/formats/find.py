"""Finds calibrations of supported tools in a folder, and reads them with the matching reader."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from client.importers.calibration import Calibration
from client.importers.formats.anipose import is_anipose, read_anipose
from client.importers.formats.caliscope import is_caliscope, read_caliscope
from client.importers.formats.easymocap import EXTRINSICS, INTRINSICS, is_easymocap, read_easymocap
from client.importers.formats.opencv_files import ENDS, camera_files, read_opencv_files
from client.importers.formats.qualisys import END as QUALISYS
from client.importers.formats.qualisys import read_qualisys
from scas4d_core.captures import CaptureError

FOLDERS = (".", "calibration")
"""Subfolders of a capture that are searched for calibrations."""
CALISCOPE = "camera_array.toml"
READ = (
    f"caliscope's {CALISCOPE}, anipose's calibration.toml, FreeMoCap's *_calibration.toml, Pose2Sim's Calib*.toml, "
    f"Qualisys' *{QUALISYS}, EasyMocap's {INTRINSICS} with {EXTRINSICS}, or OpenCV's <camera>{ENDS[0]} files"
)


def find_calibrations(capture: Path) -> list[Path]:
    """Returns the paths of the calibrations in a capture folder: files, or folders whose files form one calibration."""
    return [path for name in FOLDERS for path in _calibrations_in(capture / name)]


def _calibrations_in(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    names = sorted(path for path in folder.iterdir() if path.is_file())
    files = [path for path in names if path.name == CALISCOPE or path.name.lower().endswith(QUALISYS)]
    files += [path for path in names if _is_toml(path)]
    if is_easymocap(folder):
        files.append(folder / INTRINSICS)
    elif camera_files(folder):
        files.append(folder)
    return files


def _is_toml(path: Path) -> bool:
    """Returns whether the file is calibration.toml, Calib*.toml, or FreeMoCap's <recording>_camera_calibration.toml."""
    name = path.name.lower()
    return name.endswith("_calibration.toml") or (name.startswith("calib") and name.endswith(".toml"))


def is_calibration(path: Path) -> bool:
    """Returns whether a path could be a calibration that `read_calibration_file` can read."""
    if path.is_dir():
        return bool(_calibrations_in(path))
    return path.is_file() and (path.suffix.lower() in (".toml", *ENDS) or path.name.lower().endswith(QUALISYS))


def read_calibration_file(path: Path, capture: Path) -> Calibration:
    """Reads a calibration file, or the only calibration in a folder.

    Args:
        path: calibration file, or folder that contains exactly one calibration.
        capture: capture folder, whose images supply any image sizes that the file omits.

    Raises:
        CaptureError: if the format is unknown, the folder has several calibrations, or the file cannot be read.
        MissingExtraError: if the format needs a package from the extra `importers`.
    """
    if path.is_dir():
        here = _calibrations_in(path)
        if here == [path]:
            return read_opencv_files(path, capture)
        return read_calibration_file(single_calibration(here, path), capture)
    if path.name.lower().endswith(QUALISYS):
        return read_qualisys(path)
    if path.suffix.lower() == ".toml":
        return _read_toml(path)
    if path.name in (INTRINSICS, EXTRINSICS):
        return read_easymocap(path.parent, capture)
    return read_opencv_files(path.parent, capture)


def single_calibration(found: list[Path], folder: Path) -> Path:
    """Returns the only calibration found.

    Raises:
        CaptureError: if there are no calibrations, or several.
    """
    if len(found) == 1:
        return found[0]
    if not found:
        raise CaptureError(f"{folder} contains no calibration; supported files: {READ}")
    listed = ", ".join(str(path.relative_to(folder)) for path in found)
    raise CaptureError(
        f"{folder} contains {len(found)} calibrations ({listed}); choose one with --calibration {found[0]}, or keep "
        "only one"
    )


def _read_toml(path: Path) -> Calibration:
    try:
        with path.open("rb") as file:
            document: dict[str, Any] = tomllib.load(file)
    except (OSError, ValueError, RecursionError) as fault:  # malformed, not UTF-8, or nested too deeply
        raise CaptureError(f"{path} cannot be read as TOML: {fault}") from fault
    if is_caliscope(document):
        return read_caliscope(path, document)
    if is_anipose(document):
        return read_anipose(path, document)
    raise CaptureError(f"{path} contains no camera tables with matrix and rotation; supported files: {READ}")
