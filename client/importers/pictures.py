"""Frames from image files: one folder per camera, or files listed in the calibration. Requires only numpy and Pillow.

The frames in ``images/<camera>/<frame>.jpg`` are in natural order of their names. All images of a frame have the same
name, but may have different extensions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from client.importers.calibration import Calibration, natural
from client.importers.source import Picture
from scas4d_core.captures import CaptureError, ImageError, decode_image
from scas4d_core.captures.images import describe_pictures, picture_size

SENT = (".jpg", ".jpeg", ".png", ".webp")
"""Extensions that the service accepts without re-encoding."""
READ = (*SENT, ".bmp")
PICTURE_LIKE = (*READ, ".tif", ".tiff", ".exr", ".dng", ".raw", ".heic", ".gif", ".jp2", ".avif")
SHOWN = 3


class PictureFiles:
    """Reader for image files, with one file per camera and frame. All images of a camera must have the same size.

    Args:
        calibration: calibration of the cameras.
        files: image files of each frame [T], keyed by camera name.
        times: time of each frame in seconds; empty if unknown.

    Raises:
        CaptureError: if the first image of a camera cannot be read.
    """

    fps: float | None = None

    def __init__(self, calibration: Calibration, files: Sequence[Mapping[str, Path]], times: Sequence[float] = ()):
        self._files = files
        self._times = times
        self.frame_count = len(files)
        first = {camera: files[0][camera] for camera in calibration.names}
        try:
            self.sizes = {camera: picture_size(path) for camera, path in first.items()}
            self.remarks = describe_pictures(first)
        except ImageError as fault:
            raise CaptureError(str(fault)) from fault

    def time(self, index: int) -> float | None:
        """Returns the frame's time in seconds, or None if the calibration has no times."""
        return self._times[index] if self._times else None

    def path(self, camera: str) -> Path:
        """Returns the first image file of a camera."""
        return self._files[0][camera]

    def file(self, index: int, camera: str) -> Path | None:
        """Returns the image file of a camera and frame, or None if the service does not accept its format."""
        path = self._files[index][camera]
        return path if path.suffix.lower() in SENT else None

    def decoded(self, index: int, camera: str) -> Picture:
        """Returns the decoded image [H, W, 3] of a camera and frame."""
        return decode_image(self._files[index][camera], size=self.sizes[camera])

    def check_same_frames(self, masks: Sequence[Mapping[str, Path]]) -> None:
        """Checks that masks and images have the same frame names.

        Raises:
            CaptureError: if an image has no mask, or a mask has no image.
        """
        for index in range(max(len(masks), len(self._files))):
            picture = next(iter(self._files[index].values())) if index < len(self._files) else None
            mask = next(iter(masks[index].values())) if index < len(masks) else None
            if picture is None or mask is None or picture.stem != mask.stem:
                raise CaptureError(
                    f"frame {index}: its image is {picture}, but its mask is {mask}; name each mask like its image and "
                    "add one for every image, or use --no-masks"
                )


def folders_of(root: Path, calibration: Calibration, *, what: str = "images") -> list[dict[str, Path]]:
    """Returns the files in ``root/<camera>/`` for each frame [T], keyed by camera name.

    Raises:
        CaptureError: if a camera has no folder, or a frame is missing from some of the folders.
    """
    by_camera: dict[str, dict[str, Path]] = {}
    for camera in calibration.names:
        folder = root / camera
        if not folder.is_dir():
            there = sorted((path.name for path in root.iterdir() if path.is_dir()), key=natural)
            raise CaptureError(
                f"{folder}: no such folder, although {calibration.source} has a camera {camera!r}; {root.name}/ "
                f"contains {_some(there) or 'no folders'}; name each folder after its camera"
            )
        by_camera[camera] = _pictures_in(folder)
        if not by_camera[camera]:
            raise CaptureError(f"{folder} contains no {what}; supported file types: {', '.join(READ)}")
    frames = sorted({frame for files in by_camera.values() for frame in files}, key=natural)
    for camera, files in by_camera.items():
        missing = [frame for frame in frames if frame not in files]
        if missing:
            others = next(name for name, paths in by_camera.items() if missing[0] in paths)
            raise CaptureError(
                f"{root / camera} has no {what} for {len(missing)} of {len(frames)} frames ({_some(missing)}), but "
                f"{others!r} has them; the files of a frame must have the same name in all camera folders"
            )
    return [{camera: files[frame] for camera, files in by_camera.items()} for frame in frames]


def _pictures_in(folder: Path) -> dict[str, Path]:
    pictures: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        end = path.suffix.lower()
        if path.name.startswith(".") or end not in PICTURE_LIKE:
            continue
        if end not in READ:
            raise CaptureError(f"{path}: {end} is not supported; use JPEG, PNG, WebP or BMP")
        if path.stem in pictures:
            raise CaptureError(f"{path} and {pictures[path.stem].name} are the same frame; keep only one of them")
        pictures[path.stem] = path
    return pictures


def named_files(folder: Path, calibration: Calibration) -> tuple[list[dict[str, Path]], list[float]]:
    """Returns the files listed in the calibration for each frame [T], keyed by camera name, and the frame times.

    Frame t consists of the t-th image of each camera. Times are in seconds. They are empty if any time is unknown, or
    if there is only one frame.

    Raises:
        CaptureError: if a file is missing, cameras have different numbers of images, or the times within a frame
            differ.
    """
    counts = {camera: len(views) for camera, views in calibration.views.items()}
    most = max(counts, key=lambda camera: counts[camera])
    for camera, count in counts.items():
        if count != counts[most]:
            raise CaptureError(
                f"{calibration.source}: camera {camera!r} has {count} images, but {most!r} has {counts[most]}; "
                "provide one image per camera and frame"
            )
    frames: list[dict[str, Path]] = []
    times: list[float] = []
    for index in range(counts[most]):
        views = {camera: calibration.views[camera][index] for camera in calibration.names}
        files = {camera: _below(folder, calibration.source, str(view.path)) for camera, view in views.items()}
        frames.append(files)
        given = {camera: view.time for camera, view in views.items()}
        if len(set(given.values())) > 1:
            listed = ", ".join(f"{camera}: {time}" for camera, time in list(given.items())[:SHOWN])
            raise CaptureError(f"{calibration.source}: frame {index} has images with different times ({listed}, …)")
        now = next(iter(given.values()))
        if now is not None:
            times.append(now)
    return frames, times if len(times) == len(frames) and len(frames) > 1 else []


def _below(folder: Path, source: Path, name: str) -> Path:
    for root in (folder, folder / "images", source.parent, source.parent / "images"):
        path = root / name
        if path.is_file() and path.resolve().is_relative_to(folder.resolve()):
            return path
    raise CaptureError(f"{folder / name}: no such file, although {source} lists it")


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", …" if len(names) > SHOWN else "")
