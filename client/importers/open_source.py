"""Opens captures in any supported layout, which is detected from the files in the folder."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from client.importers.calibration import Calibration
from client.importers.formats.colmap import is_model, read_colmap
from client.importers.formats.find import (
    READ,
    find_calibrations,
    is_calibration,
    read_calibration_file,
    single_calibration,
)
from client.importers.formats.nerfstudio import FILE, read_transforms
from client.importers.pictures import PictureFiles, folders_of, named_files
from client.importers.source import Encoding, ImportedPictures, RawReader, check_times, fit_to_pictures
from client.importers.videos import ENDS, Videos, find_videos
from scas4d_core.captures import Capture, CaptureError, SizeMismatch, open_capture
from scas4d_core.captures.dynamic3dgs import TRAIN_META
from scas4d_core.rig_checks import pose_warnings

COLMAP_FOLDERS = ("sparse/0", "sparse", ".", "colmap/sparse/0", "colmap", "calibration")
PicturesFrom = Literal["images", "videos", "named"]


@dataclass(frozen=True)
class CaptureOptions:
    """Options for reading a capture, shared by all commands and studies. All are arguments of `open_source`."""

    calibration: Path | None = None
    pictures: PicturesFrom | None = None
    fps: float | None = None
    use_masks: bool = True
    test: tuple[str, ...] = ()
    size_mismatch: SizeMismatch | None = None
    encoding: Encoding = "jpeg"

    def open(self, folder: Path | str, **more: Any) -> Capture:
        """Opens a capture with these options. Arguments in `more` are passed to `open_source` and take precedence."""
        return open_source(folder, **(asdict(self) | more))

    @property
    def changed(self) -> dict[str, Any]:
        """Options that differ from the defaults, as JSON values.

        The encoding is excluded, because it does not affect decoded pixels.
        """
        usual, own = asdict(CaptureOptions()), asdict(self)
        changes = {name: value for name, value in own.items() if value != usual[name] and name != "encoding"}
        return {
            name: str(value) if isinstance(value, Path) else list(value) if isinstance(value, tuple) else value
            for name, value in changes.items()
        }


def open_source(
    folder: Path | str,
    *,
    calibration: Path | None = None,
    pictures: PicturesFrom | None = None,
    fps: float | None = None,
    encoding: Encoding = "jpeg",
    use_masks: bool = True,
    use_points: bool = True,
    image_scale: float = 1.0,
    test: tuple[str, ...] = (),
    size_mismatch: SizeMismatch | None = None,
) -> Capture:
    """Opens a capture in any supported layout (docs/captures.md). All commands and studies use this function.

    Lens distortion is removed in memory when an image is read.

    Args:
        folder: capture folder.
        calibration: transforms.json, COLMAP model folder, or calibration file of another tool
            (`client/importers/formats/`); None to search the folder.
        pictures: source of the images: `images/<camera>/`, `videos/<camera>.mp4`, or the files that the calibration
            names. If None, uses the named files if there are several per camera, otherwise whichever source exists.
        fps: frame rate that overrides the files; None for the files' frame rate, or 30 if they specify none.
        encoding: format in which undistorted images and video frames are encoded for sending or writing.
        use_masks: whether to use the masks in `masks/` or, in the Dynamic3DGaussians layout, in `seg/`.
        use_points: whether to use the point cloud.
        image_scale: factor by which images, masks and cameras are resized when they are read.
        test: names of cameras to hold out for evaluation, in addition to those that the layout holds out.
        size_mismatch: how images whose aspect ratio differs from the calibration were produced (`adapt_intrinsics`);
            None to reject such images.

    Raises:
        CaptureError: if the layout is unknown, or a file is invalid. The message names the problem.
        MissingExtraError: if undistortion or video decoding needs a package from the extra `importers`.

    >>> capture = open_source(folder)
    >>> capture.rig.names, capture.frame_count
    (('0', '1'), 4)
    >>> capture.frame(3).images["0"].shape
    (16, 24, 3)
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder")
    if fps is not None and not 0 < fps < 1e6:
        raise CaptureError(f"fps must be a positive number; got {fps!r}")
    if calibration is None and (folder / TRAIN_META).exists():
        if pictures is not None:
            raise CaptureError(
                f"{folder / TRAIN_META} already lists this capture's images; omit --pictures {pictures}, or choose "
                "another calibration with --calibration"
            )
        given = open_capture(folder, fps=fps, use_masks=use_masks, use_points=use_points, size_mismatch=size_mismatch)
    else:
        given = _imported(
            folder, read_calibration(folder, calibration), pictures, fps, encoding, use_masks, size_mismatch
        )
        given = given if use_points else replace(given, points=None)
    suspicions = pose_warnings(given.full_rig, None if given.points is None else given.points.positions)
    given = replace(given, remarks=(*given.remarks, *suspicions))
    return given.with_held_out(test).scaled(image_scale)


def _imported(
    folder: Path,
    found: Calibration,
    pictures: PicturesFrom | None,
    fps: float | None,
    encoding: Encoding,
    use_masks: bool,
    size_mismatch: SizeMismatch | None,
) -> Capture:
    raw = _pictures(folder, found, pictures)
    found, resized = fit_to_pictures(found, raw, size_mismatch)
    masks = folder / "masks"
    files = tuple(folders_of(masks, found, what="masks")) if use_masks and masks.is_dir() else ()
    if files and isinstance(raw, PictureFiles):
        raw.check_same_frames(files)
    elif files and len(files) != raw.frame_count:
        raise CaptureError(
            f"{masks} contains masks for {len(files)} of {raw.frame_count} frames; add one for every image, "
            "or use --no-masks"
        )
    reader = ImportedPictures(found, raw, masks=files, encoding=encoding)
    capture = Capture(
        folder.resolve().name,
        reader.rig,
        None,
        reader,
        fps=fps or raw.fps or found.fps or 30.0,
        points=found.points,
        remarks=(*found.remarks, *resized, *uncalibrated_remark(folder, found), *reader.remarks),
    )
    check_times(capture.name, [capture.time(index) for index in range(capture.frame_count)])
    return capture


def read_calibration(folder: Path, given: Path | None = None) -> Calibration:
    """Reads the given calibration, or searches the folder for one.

    The search order is transforms.json, a COLMAP model in one of the usual places, then a single file of another tool.

    Raises:
        CaptureError: if there is no calibration, there are several, or the calibration cannot be read.
        MissingExtraError: if the format needs a package from the extra `importers`.
    """
    if given is not None:
        if given.is_file() and given.suffix == ".json":
            return read_transforms(given)
        if given.is_dir() and is_model(given):
            return read_colmap(given)
        if is_calibration(given):
            return read_calibration_file(given, folder)
        raise CaptureError(f"{given} is neither a transforms.json, nor a COLMAP model folder, nor {READ}")
    others = find_calibrations(folder)
    if (folder / FILE).is_file():
        return _with_unread_remark(others, folder, read_transforms(folder / FILE))
    for name in COLMAP_FOLDERS:
        if is_model(folder / name):
            return _with_unread_remark(others, folder, read_colmap(folder / name))
    if others:
        return read_calibration_file(single_calibration(others, folder), folder)
    raise CaptureError(
        f"{folder}: unknown capture layout: no {TRAIN_META} (Dynamic3DGaussians), no {FILE} (nerfstudio), no "
        f"cameras.bin or cameras.txt (COLMAP) in {', '.join(COLMAP_FOLDERS)}, nor, here or in calibration/, {READ}; "
        "choose the calibration with --calibration"
    )


def _with_unread_remark(others: list[Path], folder: Path, found: Calibration) -> Calibration:
    """Returns the calibration with a remark that lists the other calibrations in the folder, which are not read."""
    if not others:
        return found
    listed = ", ".join(str(path.relative_to(folder)) for path in others)
    remark = (
        f"using calibration {found.source.relative_to(folder)}, not {listed}; choose another with --calibration FILE"
    )
    return replace(found, remarks=(*found.remarks, remark))


def uncalibrated_remark(folder: Path, calibration: Calibration) -> list[str]:
    """Returns a remark that lists cameras with images or a video but no calibration; empty if there are none."""
    images, videos = folder / "images", folder / "videos"
    there = {path.name for path in images.iterdir() if path.is_dir()} if images.is_dir() else set[str]()
    if not there and videos.is_dir():
        there = {path.stem for path in videos.iterdir() if path.suffix.lower() in ENDS}
    unknown = there.difference(calibration.names, calibration.left_out)
    left = sorted(name for name in unknown if not name.startswith("."))
    if not left or not there.intersection(calibration.names):  # otherwise these folders are not cameras
        return []
    return [f"skipped cameras that are not in {calibration.source.name}: {', '.join(left)}"]


def _pictures(folder: Path, calibration: Calibration, wanted: PicturesFrom | None) -> RawReader:
    images, videos = folder / "images", folder / "videos"
    has_images = images.is_dir() and any(path.is_dir() for path in images.iterdir())
    if wanted == "named" or (wanted is None and min(len(views) for views in calibration.views.values()) > 1):
        return _named(folder, calibration)
    if wanted is None and has_images and videos.is_dir():
        raise CaptureError(
            f"{folder} contains images/ and videos/; choose one with --pictures images or --pictures videos"
        )
    if wanted == "images" or (wanted is None and has_images):
        if not images.is_dir():
            raise CaptureError(f"{images}: no such folder; put each camera's images in images/<camera>/")
        return PictureFiles(calibration, folders_of(images, calibration))
    if wanted == "videos" or (wanted is None and videos.is_dir()):
        if not videos.is_dir():
            raise CaptureError(f"{videos}: no such folder; put each camera's video in videos/<camera>.mp4")
        return Videos(calibration, find_videos(videos, calibration))
    return _named(folder, calibration)


def _named(folder: Path, calibration: Calibration) -> PictureFiles:
    if not any(calibration.views.values()):
        raise CaptureError(
            f"{folder} contains neither images/ nor videos/, and {calibration.source.name} lists no images; put "
            "each camera's images in images/<camera>/ or its video in videos/<camera>.mp4 (cameras: "
            f"{', '.join(calibration.names)})"
        )
    return PictureFiles(calibration, *named_files(folder, calibration))
