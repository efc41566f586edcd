"""Frames in, and what became of them."""

from __future__ import annotations

import asyncio
import io
from typing import Any

from fastapi import APIRouter, Request, Response
from PIL import Image
from starlette.datastructures import UploadFile

from client.wire import FrameReceipt, FrameReportModel
from server.image_structure import StructureError, walk
from server.messages import PlyQuery
from server.problems import Problem
from server.routes.access import FrameIndex, TheScene
from server.scenes import Scene

router = APIRouter(prefix="/v1/scenes", tags=["frames"])

MASK = "mask."
EXIF_ORIENTATION = 0x0112

BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {"time": {"type": "number", "description": "Seconds; optional."}},
                    "additionalProperties": {
                        "type": "string",
                        "format": "binary",
                        "description": "One file a camera, the field called like the camera; `mask.<camera>` optional.",
                    },
                }
            }
        },
    }
}


@router.put("/{id}/frames/{n}", status_code=202, openapi_extra=BODY)
async def put(scene: TheScene, n: FrameIndex, request: Request) -> FrameReceipt:
    """Takes frame n: one JPEG, PNG or WebP a camera, in order and without gaps.

    The same frame again gets the same answer; other content under a known index is refused (409), as is a gap.
    A full queue answers 429 with Retry-After.
    """
    if not request.headers.get("content-type", "").startswith("multipart/form-data"):
        raise Problem(
            415,
            "a frame is multipart/form-data",
            field="Content-Type",
            value=request.headers.get("content-type", ""),
            remedy="send one file a camera, the field called like the camera",
        )
    # A picture sent as a plain field (no file name) would be read as text: such fields are kept short.
    async with request.form(max_files=2 * len(scene.rig) + 8, max_fields=8, max_part_size=4096) as form:
        files: dict[str, bytes] = {}
        time: float | None = None
        for name, value in form.multi_items():
            if name == "time" and isinstance(value, str):
                time = _time(value)
            elif isinstance(value, UploadFile):
                if name in files:
                    raise Problem(422, f"{name!r} is here twice", field=name, remedy="send one file a field")
                files[name] = await value.read()
            else:
                raise Problem(
                    422, f"{name!r} is no file", field=name, value=value, remedy="send it with a file name in its part"
                )
    images = {name: data for name, data in files.items() if not name.startswith(MASK)}
    masks = {name.removeprefix(MASK): data for name, data in files.items() if name.startswith(MASK)}
    await asyncio.to_thread(check_files, scene, images, masks)
    return await scene.take_frame(n, images, masks, time)


@router.get("/{id}/frames/{n}")
async def report(scene: TheScene, n: FrameIndex) -> FrameReportModel:
    """Where the frame is, and its numbers once it is committed."""
    if n not in scene.frames:
        raise Problem(404, f"frame {n} is not here", field="n", value=n, remedy=f"the next frame is {scene.next_frame}")
    return scene.frames[n].report


@router.get(
    "/{id}/frames/{n}/splat.ply",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}, "description": "A 3DGS .ply."}},
)
async def ply(scene: TheScene, n: FrameIndex) -> Response:
    """The committed frame in the file format of 3D Gaussian Splatting."""
    answer = await scene.ask(PlyQuery(scene.committed_frame(n, "n")))
    return Response(answer.body, media_type=answer.media_type)


def check_files(scene: Scene, images: dict[str, bytes], masks: dict[str, bytes]) -> None:
    """Every camera has one whole picture of its size; masks, where given, belong to all cameras."""
    names = set(scene.rig.names)
    for kind, files in (("camera", images), ("mask", masks)):
        for name in sorted(set(files) - names):
            raise Problem(
                422,
                f"the rig has no camera {name!r}",
                field=name if kind == "camera" else MASK + name,
                value=name,
                remedy=f"the cameras are {', '.join(scene.rig.names)}",
            )
        missing = sorted(names - set(files))
        if missing and (files or kind == "camera"):
            field = missing[0] if kind == "camera" else MASK + missing[0]
            raise Problem(
                422,
                f"no {'picture' if kind == 'camera' else 'mask'} of {len(missing)} cameras: {', '.join(missing)}",
                field=field,
                remedy="send one for every camera" + ("" if kind == "camera" else ", or no masks at all"),
            )
    for kind, files in (("", images), (MASK, masks)):
        for name, data in files.items():
            check_picture(scene, kind + name, name, data)


def check_picture(scene: Scene, field: str, name: str, data: bytes) -> None:
    """A whole file of a kind that is taken, of the camera's size, not turned."""
    camera = scene.rig[name]
    try:
        header = walk(data)
    except StructureError as error:
        fault = str(error)
        raise Problem(
            422, f"{field}: {fault}", field=field, value=f"{len(data)} bytes", remedy=fault.rpartition("; ")[2]
        ) from None
    if (header.width, header.height) != (camera.width, camera.height):
        raise Problem(
            422,
            f"{field}: the picture is {header.width}x{header.height}, the camera {camera.width}x{camera.height}",
            field=field,
            value=f"{header.width}x{header.height}",
            remedy="send pictures of the size the camera was calibrated for",
        )
    if field != name and header.format != "png":
        raise Problem(
            422, f"{field}: a mask as {header.format}", field=field, value=header.format, remedy="send masks as PNG"
        )
    if header.format == "jpeg" and (orientation := _orientation(data)) != 1:
        raise Problem(
            422,
            f"{field}: EXIF orientation {orientation} would turn the picture",
            field=field,
            value=orientation,
            remedy="store the pixels the way the camera was calibrated and drop the tag",
        )


def _orientation(data: bytes) -> int:
    try:
        with Image.open(io.BytesIO(data), formats=["JPEG"]) as picture:  # reads the segments, decodes nothing
            return int(picture.getexif().get(EXIF_ORIENTATION, 1))
    except Exception:  # damaged metadata: the worker finds out what it means, and says so
        return 1


def _time(value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise Problem(422, "time is no number", field="time", value=value, remedy="give seconds") from None
