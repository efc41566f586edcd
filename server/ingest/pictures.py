"""Whether the files of a frame are what its scene's rig takes, as far as a door can tell without decoding pixels."""

from __future__ import annotations

import io
from collections.abc import Sequence

from PIL import Image

from client.wire import FileKind, FrameFile
from client.wire.framing import MAX_HEAD, PREFIX
from scas4d_core.cameras import Camera, Rig
from server.ingest.image_structure import StructureError, walk
from server.problems import Problem, counted

MASK = "mask."
EXIF_ORIENTATION = 0x0112

PIXEL_BYTES = 5
"""Of one file for each of its pixels, at most: RGBA of noise as PNG has 4, and a little."""
METADATA_BYTES = 1_000_000
"""Beside the pixels: a colour profile, a preview."""


def field_of(file: FrameFile) -> str:
    """How a file is called in a form and in answers: `<camera>`, or `mask.<camera>`."""
    return MASK + file.camera if file.kind == FileKind.MASK else file.camera


def largest_file(camera: Camera) -> int:
    """Bytes that one encoded picture or mask of the camera can have at most; what is larger is something else."""
    return camera.width * camera.height * PIXEL_BYTES + METADATA_BYTES


def largest_frame(rig: Rig) -> int:
    """Bytes that a frame with masks can have at most on the wire."""
    return PREFIX.size + MAX_HEAD + 2 * sum(largest_file(camera) for camera in rig.cameras)


def check_size(camera: Camera, field: str, size: int) -> None:
    """Refuses a file by its announced size, before it is received.

    Raises:
        Problem: 413.
    """
    if size > (most := largest_file(camera)):
        raise Problem(
            413,
            f"{field}: a file of {size} bytes; a picture of {camera.width}x{camera.height} has {most} at most",
            field=field,
            value=size,
            remedy="send the picture alone, encoded as JPEG, PNG or WebP",
        )


def check_files(rig: Rig, files: Sequence[FrameFile], *, whole: bool) -> None:
    """Every camera once, of the rig; of a whole frame all of them, and masks of all or of none.

    Raises:
        Problem: 422, names the file; 413, it announces more bytes than it can have.
    """
    names = set(rig.names)
    seen: dict[FileKind, set[str]] = {FileKind.IMAGE: set(), FileKind.MASK: set()}
    for file in files:
        field = field_of(file)
        if file.camera not in names:
            raise Problem(
                422,
                f"the rig has no camera {file.camera!r}",
                field=field,
                value=file.camera,
                remedy=f"the cameras are {', '.join(rig.names)}",
            )
        if file.camera in seen[file.kind]:
            raise Problem(
                422,
                f"{field!r} is here twice",
                field=field,
                value=file.camera,
                remedy="send one file a camera and kind",
            )
        check_size(rig[file.camera], field, file.size)
        seen[file.kind].add(file.camera)
    if not whole:
        return
    for kind, given in seen.items():
        missing = sorted(names - given)
        if missing and (given or kind == FileKind.IMAGE):
            image = kind == FileKind.IMAGE
            raise Problem(
                422,
                f"no {'picture' if image else 'mask'} of {counted(len(missing), 'camera')}: {', '.join(missing)}",
                field=missing[0] if image else MASK + missing[0],
                value="nothing",
                remedy=f"add {'one' if len(missing) == 1 else 'one each'}"
                + (
                    ", or send camera by camera: PUT …/frames/{n}/cameras/{c}" if image else ", or send no masks at all"
                ),
            )


def check_picture(rig: Rig, file: FrameFile, data: memoryview) -> None:
    """A whole file of a kind that is taken, of the camera's size, not turned.

    Raises:
        Problem: 422, names the file, what it is, and the remedy.
    """
    camera, field = rig[file.camera], field_of(file)
    try:
        header = walk(data)
    except StructureError as error:
        value = error.value or counted(len(data), "byte")
        raise Problem(422, f"{field}: {error.fault}", field=field, value=value, remedy=error.remedy) from None
    if (header.width, header.height) != (camera.width, camera.height):
        raise Problem(
            422,
            f"{field}: the picture is {header.width}x{header.height}, the camera {camera.width}x{camera.height}",
            field=field,
            value=f"{header.width}x{header.height}",
            remedy="send pictures of the size the camera was calibrated for",
        )
    if file.kind == FileKind.MASK and header.format != "png":
        raise Problem(
            422, f"{field}: a mask as {header.format}", field=field, value=header.format, remedy="send masks as PNG"
        )
    if header.exif and (orientation := _orientation(data)) != 1:
        raise Problem(
            422,
            f"{field}: EXIF orientation {orientation} would turn the picture",
            field=field,
            value=orientation,
            remedy="store the pixels the way the camera was calibrated and drop the tag",
        )


def _orientation(data: memoryview) -> int:
    try:
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:  # reads the segments, decodes nothing
            return int(picture.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:  # damaged metadata: the worker finds out what it means, and says so
        return 1
