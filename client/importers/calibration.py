"""Calibrations of rigs, independent of the tool that produced them. Requires only numpy."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath, PurePosixPath

import numpy as np

from client.importers.lens import LensCamera
from scas4d_core.cameras import CAMERA_NAME
from scas4d_core.captures import CaptureError, InitialPoints

STATIC_TOLERANCE = 1e-6
"""Maximum relative difference in pose, intrinsics or distortion between images of a static camera."""


NAMES = (
    "names have at most 64 letters, digits, dots, dashes and underscores, and must not be `time` or start with a dot, "
    "a dash or `mask.`"
)
PICTURE_SUFFIXES = (
    ".jpg", ".jpeg", ".png", ".webp", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".exr", ".dng", ".raw", ".heic", ".gif",
    ".jp2", ".avif",
)  # fmt: skip
VIDEO_SUFFIXES = (
    ".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v", ".ts", ".mts", ".m2ts", ".mpg", ".mpeg", ".mxf", ".wmv", ".flv",
    ".3gp", ".h264", ".hevc", ".mjpeg",
)  # fmt: skip
SPLITS = ("train", "val", "test")
LISTED = 20
"""Number of names that a remark lists."""
SPELLED = str.maketrans({"ß": "ss", "æ": "ae", "Æ": "Ae", "ø": "o", "Ø": "O", "ł": "l", "Ł": "L", "đ": "d", "Đ": "D"})
"""Letters that Unicode does not decompose into a Latin letter and an accent."""


@dataclass(frozen=True, eq=False)
class CalibratedImage:
    """Image listed in a calibration, with its camera.

    Attributes:
        path: path as written in the calibration file.
        lens: camera that took the image. The function `calibration` assigns its name.
        time: timestamp in seconds; None if the file contains none.
    """

    path: PurePosixPath
    lens: LensCamera
    time: float | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig with lens distortion.

    Attributes:
        source: file or folder from which the calibration was read.
        cameras: cameras in natural order of their names.
        views: images listed in the calibration, in temporal order, keyed by camera name.
        points: point cloud included in the calibration, or None.
        fps: frame rate; None if the file contains none.
        remarks: messages for the user about how the calibration was read.
        left_out: names, as in the file, of cameras that are in the file but not in the rig. A remark lists them.
        labels: names of cameras in the file and on disk, keyed by the names in `cameras`, where the two differ.
        test: names of cameras that the file holds out for evaluation.
    """

    source: Path
    cameras: tuple[LensCamera, ...]
    views: Mapping[str, tuple[CalibratedImage, ...]]
    points: InitialPoints | None = None
    fps: float | None = None
    remarks: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    labels: Mapping[str, str] = field(default_factory=dict)
    test: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of `cameras`."""
        return tuple(camera.name for camera in self.cameras)

    def label(self, name: str) -> str:
        """Returns the name that a camera has in the file and on disk."""
        return self.labels.get(name, name)

    def without(self, names: Sequence[str], why: str) -> Calibration:
        """Returns the calibration without some of its cameras, and with a remark that starts with `why`."""
        return replace(
            self,
            cameras=tuple(camera for camera in self.cameras if camera.name not in names),
            views={name: views for name, views in self.views.items() if name not in names},
            remarks=(*self.remarks, f"{why}: {listed([self.label(name) for name in names])}"),
            test=tuple(name for name in self.test if name not in names),
        )


def natural(text: str) -> list[tuple[int, int, str]]:
    """Returns a sort key for natural order, in which cam2 precedes cam10."""
    parts = re.split(r"(\d{1,4000})", text)  # int() rejects more than 4300 digits
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts if part]


def composed(name: str) -> str:
    """Returns a name with composed accents. macOS stores file names with separate accents."""
    return unicodedata.normalize("NFC", name)


def listed(names: Sequence[str]) -> str:
    """Returns the names for a remark, at most `LISTED` of them."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more


def stem(path: PurePath) -> str:
    """Returns the file name without the extension of an image or video format. Some tools omit the extension."""
    return path.stem if path.suffix.lower() in (*PICTURE_SUFFIXES, *VIDEO_SUFFIXES) else path.name


def calibration(
    source: Path,
    views: Sequence[CalibratedImage],
    *,
    points: InitialPoints | None = None,
    fps: float | None = None,
    unposed: Sequence[PurePosixPath] = (),
    training: Sequence[PurePosixPath] = (),
    remarks: Sequence[str] = (),
) -> Calibration:
    """Builds a calibration by grouping images by camera.

    A camera is named after the folder of its images or, if all images are in one folder, after its image file, without
    the number at its end if the images have different times. If cameras named after folders would move, and each folder
    has an image of every camera, each folder is a frame.

    Args:
        source: file or folder from which the calibration was read.
        views: images with a pose.
        points: point cloud, or None.
        fps: frame rate, or None if unknown.
        unposed: images without a pose. Cameras that have only such images are left out, and a remark lists them.
        training: if given, cameras without any of these images are held out for evaluation.
        remarks: messages for the user.

    Raises:
        CaptureError: if there are no views, or a camera moves.
    """
    if not views:
        raise CaptureError(_no_camera(source, len(unposed)))
    folders = {_folder(path) for path in (*(view.path for view in views), *unposed)}
    times = {view.time for view in views}
    label_of: Callable[[PurePosixPath], str] = _folder_name
    if len(folders) == 1:
        label_of = stem if len(times) == 1 or not all(_series(view.path) for view in views) else _series
    try:
        cameras, by_label = _grouped(source, views, label_of)
    except CaptureError:
        label_of = stem
        if len(folders) == 1 or any(len(of) != len(folders) for of in _by_label(views, stem).values()):
            raise
        cameras, by_label = _grouped(source, views, stem)
    without = sorted({label_of(path) for path in unposed} - by_label.keys(), key=natural)
    trained = {label_of(path) for path in training}
    result = _named(source, cameras, by_label, without, "skipped cameras that have no pose")
    return replace(
        result,
        points=points,
        fps=fps,
        remarks=(*remarks, *result.remarks),
        test=tuple(name for name in result.names if trained and result.label(name) not in trained),
    )


def _folder(path: PurePosixPath) -> PurePosixPath:
    """Returns the folder of an image, without the folder of its split."""
    return path.parent.parent if path.parent.name in SPLITS else path.parent


def _folder_name(path: PurePosixPath) -> str:
    return _folder(path).name


def _series(path: PurePosixPath) -> str:
    """Returns the file name without the number of the frame at its end."""
    return re.sub(r"[_-]?\d+$", "", stem(path))


def _by_label(
    views: Sequence[CalibratedImage], label_of: Callable[[PurePosixPath], str]
) -> dict[str, tuple[CalibratedImage, ...]]:
    """Returns the images of each camera in temporal order, keyed by the camera's name in the file."""
    by_label: dict[str, list[CalibratedImage]] = {}
    for view in views:
        by_label.setdefault(composed(label_of(view.path)), []).append(view)
    for of in by_label.values():
        of.sort(key=lambda view: (view.time is not None, view.time or 0.0, natural(str(view.path))))
    return {label: tuple(of) for label, of in by_label.items()}


def _grouped(
    source: Path, views: Sequence[CalibratedImage], label_of: Callable[[PurePosixPath], str]
) -> tuple[list[LensCamera], dict[str, tuple[CalibratedImage, ...]]]:
    by_label = _by_label(views, label_of)
    return [_still(source, label, of) for label, of in by_label.items()], by_label


def calibration_of_cameras(
    source: Path,
    cameras: Sequence[LensCamera],
    left_out: Sequence[str] = (),
    why: str = "",
    remarks: Sequence[str] = (),
) -> Calibration:
    """Builds a calibration from cameras without image names.

    The images are expected in `images/<camera>/` or `videos/<camera>.mp4`.

    Args:
        source: file or folder from which the calibration was read.
        cameras: cameras of the rig, with their names in the file.
        left_out: names of cameras that are in the file but not in the rig.
        why: beginning of the remark that lists the cameras in `left_out`.
        remarks: other messages for the user.

    Raises:
        CaptureError: if there are no cameras, or a name occurs twice.
    """
    if not cameras:
        raise CaptureError(_no_camera(source, len(left_out)))
    labels = [camera.name for camera in cameras]
    for label in labels:
        if labels.count(label) > 1:
            raise CaptureError(f"{source}: two cameras are named {label!r}; rename one of them and its images")
    result = _named(source, cameras, {label: () for label in labels}, left_out, why)
    return replace(result, remarks=(*remarks, *result.remarks))


def _no_camera(source: Path, unposed: int) -> str:
    if not unposed:
        return f"{source} contains no cameras"
    return f"{source}: none of its {unposed} cameras has a pose; calibrate the rig's extrinsics too"


def _named(
    source: Path,
    cameras: Sequence[LensCamera],
    views: Mapping[str, tuple[CalibratedImage, ...]],
    left_out: Sequence[str],
    why: str,
) -> Calibration:
    """Returns a calibration whose cameras have names that the service accepts, with remarks on what was changed."""
    names = service_names(composed(camera.name) for camera in cameras)
    renamed = [replace(camera, name=names[composed(camera.name)]) for camera in cameras]
    ordered = tuple(sorted(renamed, key=lambda camera: natural(camera.name)))
    labels = {name: label for label, name in names.items() if name != label}
    changes = [f"{label!r} is now {name!r}" for name, label in labels.items()]
    remarks = [f"renamed cameras, because {NAMES}: {listed(changes)}"] if changes else []
    remarks += [f"{why}: {listed(left_out)}"] if left_out else []
    by_name = {names[composed(label)]: of for label, of in views.items()}
    return Calibration(source, ordered, by_name, remarks=tuple(remarks), left_out=tuple(left_out), labels=labels)


def service_names(labels: Iterable[str]) -> dict[str, str]:
    """Maps camera names in files to unique names that the service accepts. Accepted names are not changed.

    >>> service_names(["cam1", "GoPro #4", "Kamera Süd", "GoPro 4", "time"])
    {'cam1': 'cam1', 'GoPro #4': 'GoPro_4', 'Kamera Süd': 'Kamera_Sud', 'GoPro 4': 'GoPro_4_2', 'time': 'camera_time'}
    """
    given = list(dict.fromkeys(labels))
    taken = {label for label in given if can_be_named(label)}
    names = {}
    for label in given:
        name = label
        if label not in taken:
            plain = "".join(c for c in unicodedata.normalize("NFKD", label.translate(SPELLED)) if c.isascii())
            plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", plain).strip("_.-")[:60]
            start = plain if can_be_named(plain) else f"camera_{plain}"[:60].rstrip("_")
            name, number = start, 1
            while name in taken:
                number += 1
                name = f"{start}_{number}"
            taken.add(name)
        names[label] = name
    return names


def can_be_named(name: str) -> bool:
    """Returns whether the service accepts a camera name. Accepted names cannot contain path separators."""
    return bool(re.fullmatch(CAMERA_NAME, name)) and name != "time" and not name.startswith("mask.")


def _still(source: Path, name: str, views: Sequence[CalibratedImage]) -> LensCamera:
    first = views[0].lens
    for view in views[1:]:
        for what in ("world_to_camera", "intrinsics", "distortion"):
            old, new = getattr(first, what), getattr(view.lens, what)
            if old.shape != new.shape or np.abs(new - old).max() > STATIC_TOLERANCE * max(1.0, np.abs(old).max()):
                raise CaptureError(
                    f"{source}: {what} of camera {name!r} differs between {views[0].path} and {view.path}; the "
                    "cameras of a rig must not move: calibrate with one image per camera, or put each camera's images "
                    "into a separate folder"
                )
    return LensCamera(
        name, first.model, first.intrinsics, first.distortion, first.world_to_camera, first.width, first.height
    )
