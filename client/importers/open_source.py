"""`open_source`: opens a capture of any known layout, recognized by the files in its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from client.importers.calibration import Calibration
from client.importers.formats.colmap import is_model, read_colmap
from client.importers.formats.find import READ, found_in, is_calibration, only, read_found
from client.importers.formats.nerfstudio import FILE, read_transforms
from client.importers.pictures import PictureFiles, folders_of, named_files
from client.importers.source import CaptureSource, Encoding, ImportedSource, PictureReader, Source
from client.importers.videos import Videos, find_videos
from scas4d_core.captures import Capture, CaptureError, open_capture
from scas4d_core.captures.dynamic3dgs import TRAIN_META

COLMAP_FOLDERS = ("sparse/0", "sparse", ".", "colmap/sparse/0", "colmap", "calibration")
PicturesFrom = Literal["images", "videos", "named"]


def open_source(
    folder: Path | str,
    *,
    calibration: Path | None = None,
    pictures: PicturesFrom | None = None,
    fps: float | None = None,
    encoding: Encoding = "jpeg",
    use_masks: bool = True,
) -> Source:
    """Opens a capture of any layout that is known (docs/captures.md).

    Args:
        folder: of the capture.
        calibration: a transforms.json, the folder of a COLMAP model, or a file of another tool
            (`client/importers/formats/`); found in the folder where None.
        pictures: from where: folders `images/<camera>/`, `videos/<camera>.mp4`, or the files that the calibration
            names; where None, the latter if it names several a camera, else from what is there.
        fps: frames per second, where the files do not say.
        encoding: of pictures that have to be encoded anew: undistorted ones, and frames of videos.
        use_masks: False to leave `masks/` (`seg/`) alone.

    Raises:
        CaptureError: no known layout, or a fault in one of the files; the message says what is missing.
        MissingExtra: a lens or a video needs a package of the extra `importers`.

    >>> source = open_source(folder)
    >>> source.rig.names, source.frame_count
    (('0', '1'), 4)
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder")
    if fps is not None and not 0 < fps < 1e6:
        raise CaptureError(f"fps {fps!r} must be a positive number of frames per second")
    if calibration is None and (folder / TRAIN_META).exists():
        return CaptureSource(open_capture(folder, fps=fps, use_masks=use_masks))
    found = read_calibration(folder, calibration)
    seen = _pictures(folder, found, pictures)
    masks = folder / "masks"
    files = tuple(folders_of(masks, found, what="masks")) if use_masks and masks.is_dir() else ()
    if files and isinstance(seen, PictureFiles):
        seen.check_same_frames(files)
    elif files and len(files) != seen.frame_count:
        raise CaptureError(
            f"{masks}: has masks of {len(files)} frames, and there are {seen.frame_count}; give one of every picture, "
            "or none (--no-masks)"
        )
    return ImportedSource(folder.resolve().name, found, seen, masks=files, fps=fps, encoding=encoding)


def open_prepared(folder: Path | str) -> Capture:
    """Opens a capture that needs no importer: `reconstruct`, `evaluate` and `demo` take no other.

    Raises:
        CaptureError: another layout, or none; the message names the layouts and the way to this one.
    """
    folder = Path(folder)
    if not folder.is_dir() or (folder / TRAIN_META).exists():
        return open_capture(folder)
    raise CaptureError(
        f"{folder}: no {TRAIN_META} here, so this is no capture in the Dynamic3DGaussians layout; nerfstudio's {FILE} "
        "and COLMAP models are read by `scas4d push`, and made ready for this command by `scas4d import FOLDER OUT` "
        "(docs/captures.md)"
    )


def read_calibration(folder: Path, given: Path | None = None) -> Calibration:
    """Reads the given calibration, else transforms.json, else a COLMAP model in one of the usual places, else the one
    file of another tool that is there.

    Raises:
        CaptureError: there is none, there are several, or it cannot be read.
        MissingExtra: it needs a package of the extra `importers`.
    """
    if given is not None:
        if given.is_file() and given.suffix == ".json":
            return read_transforms(given)
        if given.is_dir() and is_model(given):
            return read_colmap(given)
        if is_calibration(given):
            return read_found(given, folder)
        raise CaptureError(f"{given}: is neither a transforms.json, nor the folder of a COLMAP model, nor {READ}")
    others = found_in(folder)
    if (folder / FILE).is_file():
        return _instead_of(others, folder, read_transforms(folder / FILE))
    for name in COLMAP_FOLDERS:
        if is_model(folder / name):
            return _instead_of(others, folder, read_colmap(folder / name))
    if others:
        return read_found(only(others, folder), folder)
    raise CaptureError(
        f"{folder}: no known capture layout: no {TRAIN_META} (Dynamic3DGaussians), no {FILE} (nerfstudio), no "
        f"cameras.bin or cameras.txt (COLMAP) in {', '.join(COLMAP_FOLDERS)}, nor, here or in calibration/, {READ}; "
        "name the calibration with --calibration"
    )


def _instead_of(others: list[Path], folder: Path, found: Calibration) -> Calibration:
    """The calibration, with a remark on others that are there and not read."""
    if not others:
        return found
    listed = ", ".join(str(path.relative_to(folder)) for path in others)
    remark = f"calibration: {found.source.relative_to(folder)}, not {listed}; --calibration FILE takes another"
    return replace(found, remarks=(*found.remarks, remark))


def _pictures(folder: Path, calibration: Calibration, wanted: PicturesFrom | None) -> PictureReader:
    images, videos = folder / "images", folder / "videos"
    has_images = images.is_dir() and any(path.is_dir() for path in images.iterdir())
    if wanted == "named" or (wanted is None and min(len(views) for views in calibration.views.values()) > 1):
        return _named(folder, calibration)
    if wanted is None and has_images and videos.is_dir():
        raise CaptureError(
            f"{folder}: has pictures in images/ and in videos/; say which: --pictures images or --pictures videos"
        )
    if wanted == "images" or (wanted is None and has_images):
        if not images.is_dir():
            raise CaptureError(f"{images}: no such folder; put each camera's pictures into images/<camera>/")
        return PictureFiles(calibration, folders_of(images, calibration))
    if wanted == "videos" or (wanted is None and videos.is_dir()):
        if not videos.is_dir():
            raise CaptureError(f"{videos}: no such folder; put each camera's video into videos/<camera>.mp4")
        return Videos(calibration, find_videos(videos, calibration))
    return _named(folder, calibration)


def _named(folder: Path, calibration: Calibration) -> PictureFiles:
    if not any(calibration.views.values()):
        raise CaptureError(
            f"{folder}: there is neither images/ nor videos/, and {calibration.source.name} names no pictures; put "
            f"each camera's into images/<camera>/ or videos/<camera>.mp4 (cameras: {', '.join(calibration.names)})"
        )
    return PictureFiles(calibration, *named_files(folder, calibration))
