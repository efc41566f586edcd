"""Opens captures in any supported layout, which is detected from the files in the folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

from client.importers.calibration import Calibration, listed
from client.importers.folders import compare, find_source, picture_sources
from client.importers.formats.find import read_calibration
from client.importers.pictures import (
    PictureFiles,
    frame_folders,
    frames_of_cameras,
    frames_of_folders,
    masks_of,
    named_files,
)
from client.importers.source import Encoding, ImportedPictures, RawReader, check_times, fit_to_pictures, unit_remarks
from client.importers.videos import Videos
from scas4d_core.captures import Capture, CaptureError, SizeMismatch, open_capture
from scas4d_core.captures.dynamic3dgs import TRAIN_META
from scas4d_core.rig_checks import pose_warnings

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
    bit_depth: int | None = None
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
    bit_depth: int | None = None,
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
        bit_depth: number of bits that the values of 16-bit images use; None to find it from the values.

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
        raise CaptureError(f"{folder}: no such folder; check the path")
    if fps is not None and not 0 < fps < 1e6:
        raise CaptureError(f"fps must be a positive number; got {fps!r}")
    if calibration is None and (folder / TRAIN_META).exists():
        if pictures is not None:
            raise CaptureError(
                f"{folder / TRAIN_META} already lists this capture's images; omit --pictures {pictures}, or choose "
                "another calibration with --calibration"
            )
        given = open_capture(
            folder,
            fps=fps,
            use_masks=use_masks,
            use_points=use_points,
            size_mismatch=size_mismatch,
            bit_depth=bit_depth,
        )
    else:
        read = read_calibration(folder, calibration)
        given = _imported(folder, read, pictures, fps, encoding, use_masks, size_mismatch, bit_depth)
        given = given if use_points else replace(given, points=None)
        names = {label: name for name, label in read.labels.items()}
        test = tuple(names.get(name, name) for name in test)
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
    bit_depth: int | None,
) -> Capture:
    found, raw = _pictures(folder, found, pictures, bit_depth)
    found, resized = fit_to_pictures(found, raw, size_mismatch)
    masks = folder / "masks"
    files = masks_of(masks, found) if use_masks and masks.is_dir() else {}
    given: Sequence[Mapping[str, Path]] = list(files.values())
    if files and isinstance(raw, PictureFiles):
        given = raw.masks(files)
    elif files and len(files) != raw.frame_count:
        raise CaptureError(
            f"{masks} contains masks for {len(files)} of {raw.frame_count} frames; add one for every image, "
            "or use --no-masks"
        )
    reader = ImportedPictures(found, raw, masks=given, encoding=encoding)
    capture = Capture(
        folder.resolve().name,
        reader.rig,
        None,
        reader,
        fps=fps or raw.fps or found.fps or 30.0,
        points=found.points,
        remarks=(*found.remarks, *resized, *reader.remarks),
    )
    times = [capture.time(index) for index in range(capture.frame_count)]
    check_times(capture.name, times)
    return replace(capture, remarks=(*capture.remarks, *unit_remarks(times, capture.fps))).with_held_out(found.test)


def _pictures(
    folder: Path, calibration: Calibration, wanted: PicturesFrom | None, bit_depth: int | None
) -> tuple[Calibration, RawReader]:
    """Returns a reader for the images, and the calibration without cameras that have none."""
    several = min(len(views) for views in calibration.views.values()) > 1
    source = None if wanted == "named" or (wanted is None and several) else find_source(folder, calibration, wanted)
    if source is None:
        return calibration, _named(folder, calibration, wanted, bit_depth)
    on_disk = source.names_of(calibration)
    if source.kind == "frames" and any(calibration.views.values()) and len(frame_folders(source.root, on_disk)) == 1:
        return calibration, named_files(folder, calibration, bit_depth)  # the images that were used to calibrate
    calibration = compare(source, calibration)
    if source.kind == "frames":
        return calibration, PictureFiles(calibration, frames_of_folders(source.root, on_disk), bit_depth=bit_depth)
    files = {camera: source.entries[name] for camera, name in on_disk.items()}
    if source.kind == "images":
        folders = {camera: paths[0] for camera, paths in files.items()}
        return calibration, PictureFiles(calibration, frames_of_cameras(folders), bit_depth=bit_depth)
    for paths in files.values():
        if len(paths) > 1:
            raise CaptureError(
                f"{source.root} contains {paths[0].name} and {paths[1].name} for the same camera; keep only one of them"
            )
    return calibration, Videos(calibration, {camera: paths[0] for camera, paths in files.items()})


def _named(folder: Path, calibration: Calibration, wanted: PicturesFrom | None, bit_depth: int | None) -> PictureFiles:
    if wanted in (None, "named") and any(calibration.views.values()):
        return named_files(folder, calibration, bit_depth)
    there = [
        f"{source.root.name}/ contains {listed(list(source.entries))}"
        for source in picture_sources(folder)
        if source.own and source.kind != "frames"
    ]
    lists = "" if any(calibration.views.values()) else f", and {calibration.source.name} lists no images"
    raise CaptureError(
        f"{folder} contains no {wanted if wanted in ('images', 'videos') else 'images or videos'} of the cameras "
        f"{listed([calibration.label(name) for name in calibration.names])}{lists}"
        f"{''.join(f'; {text}' for text in there)}; put each camera's images in images/<camera>/ or its video in "
        "videos/<camera>.mp4"
    )
