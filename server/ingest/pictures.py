"""Validation of a frame's image files: names, sizes, and whether the worker can decode them."""

from __future__ import annotations

from collections.abc import Sequence

from client.wire import FileKind, FrameFile
from client.wire.framing import MAX_HEAD, PREFIX
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures.images import check_image, check_mask
from scas4d_core.captures.picture_file import ACCEPTED, ImageError
from server.problems import Problem, count_noun

MASK = "mask."

PIXEL_BYTES = 5
"""Maximum number of bytes per pixel in a file; RGBA noise in a PNG needs slightly more than 4."""
METADATA_BYTES = 1_000_000
"""Maximum size in bytes of the metadata in a file, such as a colour profile or a preview."""


def field_of(file: FrameFile) -> str:
    """Returns the name of a file in forms and responses: `<camera>` or `mask.<camera>`."""
    return MASK + file.camera if file.kind == FileKind.MASK else file.camera


def largest_file(camera: Camera) -> int:
    """Returns the maximum size in bytes of an encoded image or mask of a camera."""
    return camera.width * camera.height * PIXEL_BYTES + METADATA_BYTES


def largest_frame(rig: Rig) -> int:
    """Returns the maximum size in bytes of an S4DF frame with images and masks of all cameras."""
    return PREFIX.size + MAX_HEAD + 2 * sum(largest_file(camera) for camera in rig.cameras)


def check_size(camera: Camera, field: str, size: int) -> None:
    """Refuses a file by its announced size, before it is received.

    Raises:
        Problem: 413 if the file is larger than an image of the camera can be.
    """
    if size > (most := largest_file(camera)):
        raise Problem(
            413,
            f"{field}: the file has {size} bytes, but a {camera.width}x{camera.height} image has at most {most}",
            field=field,
            value=size,
            remedy=f"send only the image, encoded as {ACCEPTED}",
        )


def check_camera(rig: Rig, camera: str, field: str) -> None:
    """Raises `Problem` (422) if the camera is not in the rig."""
    if camera not in rig.names:
        raise Problem(
            422,
            f"the rig has no camera {camera!r}",
            field=field,
            value=camera,
            remedy=f"use one of {', '.join(rig.names)}",
        )


def check_files(rig: Rig, files: Sequence[FrameFile], *, whole: bool) -> None:
    """Checks that each file belongs to a camera of the rig and appears only once.

    A whole frame must contain an image from every camera, and masks for all cameras or none.

    Raises:
        Problem: 422 with the name of the invalid file; 413 if an announced size is too large.
    """
    names = set(rig.names)
    seen: dict[FileKind, set[str]] = {FileKind.IMAGE: set(), FileKind.MASK: set()}
    for file in files:
        field = field_of(file)
        check_camera(rig, file.camera, field)
        if file.camera in seen[file.kind]:
            raise Problem(
                422,
                f"duplicate file {field!r}",
                field=field,
                value=file.camera,
                remedy="send one image and at most one mask per camera",
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
                f"no {'image' if image else 'mask'} for {count_noun(len(missing), 'camera')}: {', '.join(missing)}",
                field=missing[0] if image else MASK + missing[0],
                value="nothing",
                remedy=f"add {'it' if len(missing) == 1 else 'one for each'}"
                + (
                    ", or send camera by camera: PUT …/frames/{n}/cameras/{c}" if image else ", or send no masks at all"
                ),
            )


def check_picture(rig: Rig, file: FrameFile, data: memoryview) -> None:
    """Checks that the worker can decode a file, and that it has the camera's image size.

    Raises:
        Problem: 422 with the name of the file, its fault and the remedy.
    """
    camera, field = rig[file.camera], field_of(file)
    check = check_mask if file.kind == FileKind.MASK else check_image
    try:
        check(data, size=(camera.width, camera.height), name=field)
    except ImageError as error:
        value = error.value or count_noun(len(data), "byte")
        raise Problem(422, error.fault, field=field, value=value, remedy=error.remedy) from None
