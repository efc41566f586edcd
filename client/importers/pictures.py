"""Frames from image files: in folders of cameras or frames, or listed in the calibration. Needs only numpy and Pillow.

The frames in ``images/<camera>/<frame>.jpg`` are in natural order of their names. All images of a frame have the same
name, but may have different extensions, and may start with the name of their camera (``<camera>_<frame>.jpg``).
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from client.importers.calibration import PICTURE_SUFFIXES, Calibration, composed, listed, natural, stem
from client.importers.source import Picture
from scas4d_core.cameras import minimum_cameras
from scas4d_core.captures import CaptureError, ImageError, decode_image
from scas4d_core.captures.images import describe_pictures, eight_bit_file, usual_size
from scas4d_core.captures.picture_file import ACCEPTED
from scas4d_core.captures.reader import read_bytes

SENT = (".jpg", ".jpeg", ".png", ".webp")
"""Extensions of files that are sent without re-encoding."""
READ = (*SENT, ".bmp", ".ppm", ".pgm")
SHOWN = 3

Frames = Mapping[str, Mapping[str, Path]]
"""Image files of each frame in order, keyed by the name of the frame and by camera name."""


class PictureFiles:
    """Reader for image files, with one file per camera and frame. All images of a camera must have the same size.

    The capture ends with the last frame that has images of half of the cameras.

    Args:
        calibration: calibration of the cameras.
        files: image files of each frame, keyed by the name of the frame and by camera name. Missing files are absent.
        times: time of each frame in seconds; empty if unknown.
        remarks: messages for the user.
        bit_depth: number of bits that the values of 16-bit images use; None to find it from the values.

    Attributes:
        bit_depth: the bit depth, or None if there are no 16-bit images.
        sizes: (width, height) of the images of each camera that has a readable image, keyed by camera name.

    Raises:
        CaptureError: if fewer than half of the cameras have a readable image.
    """

    fps: float | None = None

    def __init__(
        self,
        calibration: Calibration,
        files: Frames,
        times: Sequence[float] = (),
        remarks: Sequence[str] = (),
        *,
        bit_depth: int | None = None,
    ) -> None:
        self._files = [
            {camera: frame[camera] for camera in calibration.names if camera in frame} for frame in files.values()
        ]
        self._names = list(files)
        self._times = times
        least = minimum_cameras(len(calibration.cameras))
        self.frame_count = 1 + max((index for index, of in enumerate(self._files) if len(of) >= least), default=-1)
        self._last = {camera: index for index, of in enumerate(self._files) for camera in of}
        self._first: dict[str, Path] = {}
        self.sizes = {}
        fault: ImageError | None = None
        for lens in calibration.cameras:
            paths = [of[lens.name] for of in self._files if lens.name in of]
            try:
                self._first[lens.name], self.sizes[lens.name] = usual_size(paths, (lens.width, lens.height))
            except ImageError as error:
                fault = fault or error
        if fault is not None and len(self._first) < least:
            raise CaptureError(str(fault)) from fault
        try:
            self.bit_depth, described = describe_pictures(self._first, self._files, bit_depth)
        except ImageError as error:
            raise CaptureError(str(error)) from error
        self.remarks = [*remarks, *described]
        if (more := len(self._files) - self.frame_count) > 0:
            self.remarks.append(f"ignored the last {more} frames, of which fewer than {least} cameras have an image")

    def time(self, index: int) -> float | None:
        """Returns the frame's time in seconds, or None if the calibration has no times."""
        return self._times[index] if self._times else None

    def path(self, camera: str) -> Path:
        """Returns the first image file of a camera in `sizes` that has this size."""
        return self._first[camera]

    def file(self, index: int, camera: str) -> bytes | None:
        """Returns a JPEG, PNG or WebP file of a camera and frame, converted to 8 bits if necessary; otherwise None.

        Raises:
            ImageError: if it is missing, cannot be decoded or has another size.
        """
        path = self._path(index, camera)
        if path.suffix.lower() not in SENT:
            return None
        return eight_bit_file(read_bytes(path), self.sizes.get(camera), str(path), self.bit_depth)

    def decoded(self, index: int, camera: str) -> Picture:
        """Returns the decoded image [H, W, 3] of a camera and frame.

        Raises:
            ImageError: if it is missing, cannot be decoded or has another size.
        """
        return decode_image(self._path(index, camera), size=self.sizes.get(camera), bit_depth=self.bit_depth)

    def _path(self, index: int, camera: str) -> Path:
        files = self._files[index]
        if camera in files:
            return files[camera]
        last = self._last.get(camera, -1)
        if 0 <= last < index:
            raise ImageError(f"{self._files[last][camera]} is its last image")
        there = next(iter(files.values()), None)
        raise ImageError(f"camera {camera!r} has no image that belongs to {there or f'frame {self._names[index]!r}'}")

    def masks(self, masks: Frames) -> list[Mapping[str, Path]]:
        """Returns the masks of each frame [T], keyed by camera name.

        Raises:
            CaptureError: if an image has no mask, or a mask has no image.
        """
        given = list(masks)
        for index in range(max(len(given), len(self._names))):
            frame = self._names[index] if index < len(self._names) else None
            name = given[index] if index < len(given) else None
            images = {} if frame is None else self._files[index]
            there = {} if name is None else masks[name]
            bare = next((path for camera, path in images.items() if camera not in there), None)
            if frame != name or bare is not None:
                picture = bare or next(iter(images.values()), None)
                raise CaptureError(
                    f"frame {index}: its image is {picture}, but its mask is "
                    f"{None if bare is not None and frame == name else next(iter(there.values()), None)}; name each "
                    "mask like its image and add one for every image, or use --no-masks"
                )
        return list(masks.values())


def frames_of_cameras(folders: Mapping[str, Path], *, what: str = "images") -> dict[str, dict[str, Path]]:
    """Returns the files in one folder per camera, keyed by the name of the frame and by camera name.

    Args:
        folders: folder of each camera, keyed by camera name.
        what: kind of the files, for messages.

    Missing files are absent in the result.

    Raises:
        CaptureError: if a folder is empty, or has no frame in common with most of the others.
    """
    by_camera = {camera: _pictures_in(folder) for camera, folder in folders.items()}
    for camera, files in by_camera.items():
        if not files:
            raise CaptureError(f"{folders[camera]} contains no {what}; supported file types: {', '.join(READ)}")
    frames = sorted({frame for files in by_camera.values() for frame in files}, key=natural)
    by_frame = {
        frame: {camera: files[frame] for camera, files in by_camera.items() if frame in files} for frame in frames
    }
    alone = _without_common_frame(by_frame, list(folders))
    if alone is not None:
        missing = [frame for frame in frames if frame not in by_camera[alone]]
        others = next(name for name, paths in by_camera.items() if missing[0] in paths)
        raise CaptureError(
            f"{folders[alone]} has no {what} for {len(missing)} of {len(frames)} frames ({_some(missing)}), but "
            f"{others!r} has them; the files of a frame must have the same name in all camera folders"
        )
    return by_frame


def _without_common_frame(frames: Frames, cameras: Sequence[str]) -> str | None:
    """Returns a camera that has none of the frames of which most cameras have a file, or None if there is no such one.

    Its files are probably named differently. A camera that lacks single files is not returned. Of several such cameras,
    the one with the fewest files is returned.
    """
    common = [files for files in frames.values() if 2 * len(files) > len(cameras)]
    alone = [camera for camera in cameras if not any(camera in files for files in common)]
    return min(alone, key=lambda camera: sum(camera in files for files in frames.values()), default=None)


def frames_of_folders(root: Path, stems: Mapping[str, str]) -> dict[str, dict[str, Path]]:
    """Returns the images in one folder per frame, ``root/<frame>/<camera>.jpg``.

    Args:
        root: folder that contains the folders of the frames.
        stems: file name of each camera's images without extension, keyed by camera name.

    Missing files are absent in the result.

    Raises:
        CaptureError: if a camera has no image in the folders that contain most of the others.
    """
    frames = frame_folders(root, stems)
    camera = _without_common_frame(frames, list(stems))
    if camera is not None:
        frame = next(frame for frame, files in frames.items() if camera not in files)
        raise CaptureError(f"{root / frame} has no image of {stems[camera]}; every frame needs an image of each camera")
    return frames


def frame_folders(root: Path, stems: Mapping[str, str]) -> dict[str, dict[str, Path]]:
    """Returns the images of the given cameras in each folder that contains any, in natural order of the folders."""
    frames = {}
    for folder in sorted((path for path in root.iterdir() if path.is_dir()), key=lambda path: natural(path.name)):
        files = {composed(path.stem): path for path in _pictures_in(folder, readable_entries(folder)).values()}
        there = {camera: files[name] for camera, name in stems.items() if name in files}
        if there:
            frames[folder.name] = there
    return frames


def masks_of(root: Path, calibration: Calibration) -> dict[str, dict[str, Path]]:
    """Returns the masks in ``root/<camera>/``, keyed by the name of the frame and by camera name.

    Raises:
        CaptureError: if a camera has no folder, or a frame is missing from some of the folders.
    """
    there = {composed(path.name): path for path in sorted(root.iterdir()) if path.is_dir()}
    folders = {}
    for camera in calibration.names:
        folder = there.get(calibration.label(camera), there.get(camera))
        if folder is None:
            raise CaptureError(
                f"{root / calibration.label(camera)}: no such folder; {root.name}/ contains "
                f"{listed(sorted(there, key=natural)) or 'no folders'}; add masks of every camera, or use --no-masks"
            )
        folders[camera] = folder
    return frames_of_cameras(folders, what="masks")


def readable_entries(folder: Path) -> list[Path]:
    """Returns the entries of a folder, or an empty list if they must not be listed, like those of `lost+found`."""
    try:
        return list(folder.iterdir())
    except PermissionError:
        return []


def _pictures_in(folder: Path, entries: Iterable[Path] | None = None) -> dict[str, Path]:
    pictures: dict[str, Path] = {}
    for path in sorted(folder.iterdir() if entries is None else entries):
        end = path.suffix.lower()
        if path.name.startswith(".") or end not in PICTURE_SUFFIXES:
            continue
        if end not in READ:
            raise CaptureError(f"{path}: {end} is not supported; use {ACCEPTED}")
        if path.stem in pictures:
            raise CaptureError(f"{path} and {pictures[path.stem].name} are the same frame; keep only one of them")
        pictures[path.stem] = path
    camera = f"{folder.name}_"
    if all(name.startswith(camera) and name != camera for name in pictures):
        return {name.removeprefix(camera): path for name, path in pictures.items()}
    return pictures


def named_files(folder: Path, calibration: Calibration, bit_depth: int | None = None) -> PictureFiles:
    """Returns a reader for the files that the calibration lists.

    Frame t consists of the t-th image of each camera. Times are in seconds. They are used only if all are known, and
    if there are several frames. A remark lists images in the same folders that the calibration does not list. Missing
    files are left out.

    Raises:
        CaptureError: if too many files are missing, cameras have different numbers of images, or the times within a
            frame differ.
    """
    counts = {camera: len(views) for camera, views in calibration.views.items()}
    most = max(counts, key=lambda camera: counts[camera])
    for camera, count in counts.items():
        if count != counts[most]:
            raise CaptureError(
                f"{calibration.source}: camera {camera!r} has {count} images, but {most!r} has {counts[most]}; "
                "provide one image per camera and frame"
            )
    frames: dict[str, dict[str, Path]] = {}
    times: list[float] = []
    absent: list[PurePosixPath] = []
    enough = False
    for index in range(counts[most]):
        views = {camera: calibration.views[camera][index] for camera in calibration.names}
        files = {}
        for camera, view in views.items():
            file = find_picture(folder, calibration.source, str(view.path))
            if file is None:
                absent.append(view.path)
            else:
                files[camera] = file
        enough = enough or len(files) >= minimum_cameras(len(views))
        name = stem(next(iter(views.values())).path)
        frames[name if name not in frames else f"{index} {name}"] = files
        given = {camera: view.time for camera, view in views.items()}
        if len(set(given.values())) > 1:
            some = ", ".join(f"{camera}: {time}" for camera, time in list(given.items())[:SHOWN])
            raise CaptureError(f"{calibration.source}: frame {index} has images with different times ({some}, …)")
        now = next(iter(given.values()))
        if now is not None:
            times.append(now)
    if not enough:
        raise CaptureError(f"{folder / absent[0]}: no such file, although {calibration.source} lists it")
    return PictureFiles(
        calibration,
        frames,
        times if len(times) == len(frames) and len(frames) > 1 else [],
        _unlisted(frames, calibration),
        bit_depth=bit_depth,
    )


def _unlisted(frames: Frames, calibration: Calibration) -> list[str]:
    """Returns a remark on images that lie beside the listed ones, but are not listed."""
    used = {path for files in frames.values() for path in files.values()}
    there = {path for folder in {path.parent for path in used} for path in folder.iterdir()}
    left = [path.name for path in there - used if path.suffix.lower() in READ and not path.name.startswith(".")]
    if not left:
        return []
    return [f"skipped images that are not in {calibration.source.name}: {listed(sorted(left, key=natural))}"]


def find_picture(folder: Path, source: Path, name: str) -> Path | None:
    """Returns the image that a calibration lists, or None if the capture does not contain it.

    The name may lack the extension. Of an absolute path, as on the machine that calibrated, the end is searched for.

    Args:
        folder: capture folder.
        source: calibration file or folder, to which names may be relative.
        name: path as in the calibration.
    """
    path = PurePosixPath(name)
    ends = [name]
    if path.is_absolute() or PureWindowsPath(name).drive or ".." in path.parts:
        parts = [part for part in path.parts if part not in ("/", "..")]
        ends += ["/".join(parts[start:]) for start in range(len(parts))]
    here = source if source.is_dir() else source.parent
    added = [""] if path.suffix.lower() in PICTURE_SUFFIXES else ["", *READ, *(end.upper() for end in READ)]
    for end in ends:
        for root in (folder, folder / "images", here, here / "images"):
            for suffix in added:
                file = root / f"{end}{suffix}"
                # Unlike Path.is_file, os.path.isfile returns False for names that are too long.
                if os.path.isfile(file) and file.resolve().is_relative_to(folder.resolve()):
                    return file
    return None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:SHOWN]) + (", …" if len(names) > SHOWN else "")
