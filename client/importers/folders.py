"""Finds the images and videos of a capture's cameras, and compares them with the cameras of a calibration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from client.importers.calibration import VIDEO_SUFFIXES, Calibration, composed, listed, natural, stem
from client.importers.pictures import READ, frame_folders, readable_entries
from client.importers.video.reader import Video
from scas4d_core.captures import CaptureError, ImageError
from scas4d_core.captures.images import usual_size

IMAGES = ("images", "hdImgs", "frames", ".")
VIDEOS = ("videos", "hdVideos", ".")
NOT_CAMERAS = {*IMAGES, *VIDEOS, "masks", "sparse", "dense", "colmap", "calibration", "ims", "seg"}
"""Folders in a capture that are not cameras or frames."""
PANOPTIC = ("hd_", "vga_", "kinect_")
"""CMU Panoptic's videos are named after the type and the name of their camera."""

COMPARED = 5
"""Number of frame folders among which the one with the most images is compared with the cameras."""

Kind = Literal["images", "frames", "videos"]


@dataclass(frozen=True, eq=False)
class PictureSource:
    """A folder with the images or videos of several cameras.

    Attributes:
        kind: `images` for ``root/<camera>/<frame>.jpg``, `frames` for ``root/<frame>/<camera>.jpg``, or `videos` for
            ``root/<camera>.mp4``.
        root: the folder.
        entries: folder, first image, or videos of each camera, keyed by its name on disk.
        own: whether the folder contains nothing but cameras, unlike the capture folder.
    """

    kind: Kind
    root: Path
    entries: Mapping[str, Sequence[Path]]
    own: bool

    def find(self, *names: str) -> str | None:
        """Returns the name on disk of a camera with one of several names, or None."""
        for name in map(composed, names):
            for prefix in ("", *PANOPTIC):
                if prefix + name in self.entries:
                    return prefix + name
        return None

    def names_of(self, calibration: Calibration) -> dict[str, str]:
        """Returns the names on disk of the cameras that are here, keyed by camera name."""
        names = ((name, self.find(calibration.label(name), name)) for name in calibration.names)
        return {name: on_disk for name, on_disk in names if on_disk is not None}


def picture_sources(capture: Path) -> Iterator[PictureSource]:
    """Finds the folders with images or videos in a capture: `images`, `hdImgs`, `videos`, …, or the capture itself."""
    for place in IMAGES:
        root, own = capture / place, place != "."
        folders = {
            composed(path.name): path
            for path in sorted(root.iterdir() if root.is_dir() else (), key=lambda path: natural(path.name))
            if path.is_dir() and not path.name.startswith(".") and (own or path.name not in NOT_CAMERAS)
        }
        pictured = [name for name, path in folders.items() if any(map(_is_picture, readable_entries(path)))]
        if folders if own else pictured:
            yield PictureSource("images", root, {name: [folders[name]] for name in (folders if own else pictured)}, own)
        if pictured:
            # An image of the first frame may be missing.
            fullest = max((pictures_in(folders[name]) for name in pictured[:COMPARED]), key=len)
            yield PictureSource("frames", root, {composed(stem(path)): [path] for path in fullest}, own)
    for place in VIDEOS:
        root = capture / place
        videos: dict[str, list[Path]] = {}
        for path in sorted(root.iterdir() if root.is_dir() else ()):
            if path.suffix.lower() in VIDEO_SUFFIXES and path.is_file() and not path.name.startswith("."):
                videos.setdefault(composed(path.stem), []).append(path)
        if videos:
            yield PictureSource("videos", root, videos, own=True)


def pictures_in(folder: Path) -> list[Path]:
    """Returns the images in a folder, in natural order."""
    if not folder.is_dir():
        return []
    return sorted(filter(_is_picture, folder.iterdir()), key=lambda path: natural(path.name))


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in READ and not path.name.startswith(".")


def find_source(capture: Path, calibration: Calibration, wanted: str | None) -> PictureSource | None:
    """Returns the folder that contains the cameras of a calibration, or None if no folder contains any.

    Args:
        capture: capture folder.
        calibration: the cameras.
        wanted: `images` or `videos`; None for either.

    Raises:
        CaptureError: if there are both images and videos, and `wanted` is None.
    """
    sources = [source for source in picture_sources(capture) if wanted is None or _is(source, wanted)]
    counts = [(source, count) for source in sources if (count := len(source.names_of(calibration)))]
    if not counts:
        return None
    best = max(counts, key=lambda pair: pair[1])[0]
    other = next((source for source, _ in counts if not _is(source, best.kind)), None)
    if other is not None:
        images, videos = (other, best) if best.kind == "videos" else (best, other)
        raise CaptureError(
            f"{capture} contains images ({_below(images.root, capture)}) and videos ({_below(videos.root, capture)}); "
            "choose one with --pictures images or --pictures videos"
        )
    return best


def _is(source: PictureSource, wanted: str) -> bool:
    return (source.kind == "videos") == (wanted == "videos")


def _below(root: Path, capture: Path) -> str:
    return f"{root.relative_to(capture)}/" if root != capture else "this folder"


def compare(source: PictureSource, calibration: Calibration) -> Calibration:
    """Leaves out cameras without images, and adds remarks on cameras that are only in the calibration or only here.

    Raises:
        CaptureError: if there are both, because then names probably differ.
    """
    names = source.names_of(calibration)
    missing = [name for name in calibration.names if name not in names]
    left_out = {source.find(label) for label in calibration.left_out}
    unknown = [name for name in source.entries if name not in names.values() and name not in left_out]
    what = "video" if source.kind == "videos" else "images"
    if missing and unknown and source.own:
        raise CaptureError(
            f"{source.root} contains no {what} of camera {calibration.label(missing[0])!r} of {calibration.source}, "
            f"but it contains {listed(unknown)}, which the calibration does not; name each "
            f"{ {'images': 'folder', 'frames': 'image', 'videos': 'video'}[source.kind] } after its camera, or remove "
            "what does not belong to the rig"
        )
    if missing:
        calibration = calibration.without(missing, f"skipped cameras that have no {what} in {source.root.name}")
    if unknown and source.own:
        remark = f"skipped cameras that are not in {calibration.source.name}: {listed(sorted(unknown, key=natural))}"
        return replace(calibration, remarks=(*calibration.remarks, remark))
    return calibration


def size_of_pictures(capture: Path, camera: str, where: str) -> tuple[int, int]:
    """Returns (width, height) of the first image or the video of a camera.

    Args:
        capture: capture folder.
        camera: camera name.
        where: name of the file and of the camera that has no size, for error messages.

    Raises:
        CaptureError: if there is neither an image nor a video, or the file cannot be read.
        MissingExtraError: if a video must be read and PyAV is not installed.
    """
    for source in picture_sources(capture):
        name = source.find(camera)
        if name is None:
            continue
        path = source.entries[name][0]
        if source.kind == "videos":
            with closing(Video(path)) as video:
                return video.size
        if source.kind == "images":
            files = pictures_in(path)
        else:
            files = [file for of in frame_folders(source.root, {camera: name}).values() for file in of.values()]
        if files:
            return image_size(files)
    for place in IMAGES:
        for path in pictures_in(capture / place):
            if composed(path.stem) == composed(camera):
                return image_size([path])
    raise CaptureError(
        f"{where} has no image size, and {capture} contains no images or video of the camera to read it from; put them "
        f"in images/{camera}/ or videos/{camera}.mp4, or add the size to the file"
    )


def image_size(paths: Sequence[Path]) -> tuple[int, int]:
    """Returns the usual (width, height) of the images of a camera.

    Raises:
        CaptureError: if none of them can be read.
    """
    try:
        return usual_size(paths)[1]
    except ImageError as fault:
        raise CaptureError(str(fault)) from fault
