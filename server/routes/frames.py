"""Routes for frames: upload, stored images, reports and export."""

from __future__ import annotations

import asyncio
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request, Response
from starlette.requests import ClientDisconnect

from client.wire import (
    FRAME_MEDIA_TYPE,
    CameraReceipt,
    FileKind,
    FrameBatch,
    FrameReceipt,
    FrameReportModel,
    FrameSeconds,
    MissingRequest,
)
from client.wire.frames import FrameList
from server.http.immutable import immutable_response
from server.ingest.batch import REFUSED_CONTENT, Batch, Numbering, OnRefusal, receive_batch, receive_form_batch
from server.ingest.camera_files import receive_camera, receive_file, receive_form
from server.ingest.receive import receive_frame
from server.problems import Problem
from server.processes.queries import CompactQuery, PlyQuery
from server.routes.access import FrameIndex, TheRecord, TheScene, ask
from server.scene.scene import Scene
from server.storage.frame_store import FrameDamage, read_pictures

router = APIRouter(prefix="/v1/scenes", tags=["frames"])

BINARY = {"type": "string", "format": "binary"}


def _request_body(frames: str, others: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Describes a request body in OpenAPI.

    Args:
        frames: description of the body in the format S4DF.
        others: schemas of the other media types, by media type.
    """
    schemas = {FRAME_MEDIA_TYPE: {**BINARY, "description": frames}, **others}
    content = {kind: {"schema": schema} for kind, schema in schemas.items()}
    return {"requestBody": {"required": True, "content": content}}


def _form(files: str, **fields: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    schema = {"type": "object", "additionalProperties": {**BINARY, "description": files}}
    return {"multipart/form-data": schema | ({"properties": fields} if fields else {})}


BODY = _request_body(
    "S4DF, described in docs/api.md.",
    _form(
        "Image of the camera with the name of the field; `mask.<camera>` is its mask.",
        time={"type": "number", "description": "Frame time in seconds; optional."},
    ),
)
BATCH_BODY = _request_body(
    "S4DF frames, one after another, as described in docs/api.md.",
    _form(
        "A field as for a single frame, with the frame index before its name: `0/<camera>`, `0/mask.<camera>`, "
        "`0/time`."
    ),
)
ANSWERS: dict[int | str, dict[str, Any]] = {
    207: {"model": FrameBatch, "description": "At least one frame was refused; see its `problem`."}
}
PICTURE = _request_body(
    "Image and mask of the camera in one body.", dict.fromkeys(("image/jpeg", "image/png", "image/webp"), BINARY)
)
MOST_FRAMES = 500
"""Maximum number of frames per response; each report lists every camera."""
MOST_STATES = 120
"""Maximum number of frames in a requested compact file; they take a few seconds of reader time and a few megabytes."""
SENT_AS = {
    b"\xff\xd8": ("image/jpeg", ".jpg"),
    b"\x89P": ("image/png", ".png"),
    b"RI": ("image/webp", ".webp"),
    b"P5": ("image/x-portable-graymap", ".pgm"),
    b"P6": ("image/x-portable-pixmap", ".ppm"),
}
"""Media type and file extension of an image file, keyed by its first two bytes."""
FILE: dict[int | str, dict[str, Any]] = {
    200: {"content": {kind: {"schema": BINARY} for kind, _ in SENT_AS.values()}, "description": "File as uploaded."}
}
CameraPath = Annotated[str, Path(max_length=64, description="Name of a camera of the rig.")]
Seconds = Annotated[
    FrameSeconds | None,
    Query(description="Time of the frame in seconds; the first value sent by any camera is used."),
]


@router.put("/{id}/frames/{n}", status_code=202, openapi_extra=BODY)
async def put(scene: TheScene, n: FrameIndex, request: Request) -> FrameReceipt:
    """Accepts frame n with one image file per camera; frames must arrive in order and without gaps.

    The frame is on disk when the response is sent. Sending the same frame again returns the same response. Different
    content for a known index, and gaps, are refused (409, with the expected index). If the queue is full, the response
    is 429 with Retry-After, or the frame is skipped if the scene is configured this way. If the disk is full, the
    response is 507.
    """
    kind = _media_type(request)
    with _connected("frame"):
        if kind == FRAME_MEDIA_TYPE:
            return await receive_frame(scene.ingest, n, request.stream(), _length(request))
        if kind == "multipart/form-data":
            return await receive_form(scene.ingest, n, request)
    raise _media_type_problem(request)


@router.post("/{id}/frames", status_code=202, responses=ANSWERS, openapi_extra=BATCH_BODY)
async def post(
    scene: TheScene,
    request: Request,
    response: Response,
    numbering: Annotated[
        Numbering,
        Query(description="given: the frames have their own indices; next: they get the next ones, and need a time."),
    ] = Numbering.GIVEN,
    on_refusal: Annotated[
        OnRefusal,
        Query(description="skip: a frame with refused content does not stop the batch; stop: it ends the batch."),
    ] = OnRefusal.SKIP,
) -> FrameBatch:
    """Accepts a batch of one or more frames and returns one answer per frame, in order.

    The status is 202 if all frames were accepted and 207 otherwise. A frame that is refused because of its content does
    not stop the batch. Its answer contains the problem; if the batch continues with the next index, the refused frame
    is declared missing. With `on_refusal=stop`, it ends the batch instead, so that it can be corrected and sent again;
    all further frames get its answer. If no frame can be accepted at present, the response is 429, 503 or 507. If that
    happens after the first frames, all further frames get this answer. Sending a batch again returns the same answers
    for frames that were accepted before.
    """
    kind = _media_type(request)
    with _connected("batch"):
        if kind == FRAME_MEDIA_TYPE:
            batch = await receive_batch(scene.open_frames, numbering, on_refusal, request.stream())
        elif kind == "multipart/form-data":
            batch = await receive_form_batch(scene.open_frames, numbering, on_refusal, request)
        else:
            raise _media_type_problem(request)
    return _answer(batch, response)


def _answer(batch: Batch, response: Response) -> FrameBatch:
    statuses = {answer.status for answer in batch.answers}
    stopped = batch.stopped
    if stopped is not None and statuses == {stopped.status_code} and stopped.status_code not in REFUSED_CONTENT:
        raise stopped
    response.status_code = 202 if statuses == {202} else 207
    return FrameBatch(answers=batch.answers)


@router.put("/{id}/frames/{n}/cameras/{c}", status_code=202, openapi_extra=PICTURE)
async def put_camera(
    scene: TheScene,
    n: FrameIndex,
    c: CameraPath,
    request: Request,
    time: Seconds = None,
    kind: Annotated[FileKind, Query(description="Send a mask before its image, or both in one S4DF body.")] = (
        FileKind.IMAGE
    ),
) -> CameraReceipt:
    """Accepts one camera's image of frame n, for rigs whose cameras send separately.

    The image is on disk when the response is sent. The frame closes when the images of all cameras have arrived, on
    POST …/close, or at the scene's deadline. A camera may be a few frames ahead of the others. Frames close in order.
    """
    with _connected("image"):
        if _media_type(request) == FRAME_MEDIA_TYPE:
            return await receive_camera(scene.open_frames, n, c, request.stream(), _length(request))
        return await receive_file(scene.open_frames, n, c, kind, time, request.stream(), _length(request))


@router.get("/{id}/frames/{n}/cameras/{c}", response_class=Response, responses=FILE)
async def picture(
    scene: TheRecord,
    n: FrameIndex,
    c: CameraPath,
    request: Request,
    kind: Annotated[FileKind, Query(description="Whether to return the image or its mask.")] = FileKind.IMAGE,
) -> Response:
    """Returns one camera's image of frame n, byte for byte as uploaded.

    The scene's `ingest.keep_frames` determines how long images are kept. A 404 states what is missing: the camera, the
    frame, all of its images, or this image.
    """
    data = await _stored(scene, n, c, kind)
    media_type, ending = SENT_AS[bytes(data[:2])]
    name = f"{scene.id[:8]}-{n:06d}-{c}{'' if kind == FileKind.IMAGE else '-mask'}{ending}"
    return immutable_response(request, data, media_type=media_type, name=name, inline=True)


@router.post("/{id}/frames/{n}/close", status_code=202)
async def close(scene: TheScene, n: FrameIndex) -> FrameReceipt:
    """Closes a frame with the single-camera images received so far; later images are refused."""
    return await scene.open_frames.close(n)


@router.post("/{id}/frames/{n}/missing")
async def missing(scene: TheScene, n: FrameIndex, request: MissingRequest | None = None) -> FrameReportModel:
    """Declares the next frame permanently missing, so that a rig that lost it can continue with the frame after it.

    Images of the frame that have already arrived are discarded. The next update spans the longer time interval.
    """
    return await scene.open_frames.declare_missing(n, "" if request is None else request.reason)


@router.get("/{id}/frames")
async def frames(
    scene: TheScene,
    first: Annotated[int, Query(ge=0, le=1_000_000_000, description="Index of the first frame.")] = 0,
    limit: Annotated[int, Query(ge=1, le=MOST_FRAMES, description="Maximum number of frames.")] = MOST_FRAMES,
) -> FrameList:
    """Returns the reports of up to `limit` frames starting at `first`; `next` is the `first` of the next page."""
    after = min(first + limit, scene.next_frame)  # frame indices have no gaps
    reports = [await scene.report(index) for index in range(first, after)]
    short = [report.model_copy(update={"loss": [], "curve": []}) for report in reports if report is not None]
    return FrameList(frames=short, next=after if first <= after < scene.next_frame else None)


@router.get("/{id}/frames/{n}")
async def report(scene: TheRecord, n: FrameIndex) -> FrameReportModel:
    """Returns the state of a frame, and its timings and metrics once it is committed."""
    frame_report = await scene.report(n)
    if frame_report is None:
        raise Problem(
            404,
            f"frame {n} has not arrived",
            field="n",
            value=n,
            remedy=f"send it, or wait for it: the next frame is {scene.next_frame}",
        )
    return frame_report


@router.get(
    "/{id}/frames/{n}/splat.ply",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}, "description": "3DGS .ply file."}},
)
async def ply(scene: TheScene, n: FrameIndex, request: Request) -> Response:
    """Returns a committed frame as a 3D Gaussian Splatting .ply file."""
    answer = await ask(request, scene, PlyQuery(scene.committed_frame(n, "n")))
    return immutable_response(request, answer.body, media_type=answer.media_type, name=f"{scene.id[:8]}-{n:06d}.ply")


@router.get(
    "/{id}/states.s4d",
    response_class=Response,
    responses={
        200: {
            "content": {"application/octet-stream": {}},
            "description": "Compact 4D file (docs/format.md).",
            "headers": {
                "X-Last-Frame": {"schema": {"type": "integer"}, "description": "Index of the last frame in the file."},
                "X-Next-Frame": {
                    "schema": {"type": "integer"},
                    "description": "Value of `first` for the next request; absent if there are no further frames.",
                },
            },
        }
    },
)
async def compact(
    scene: TheScene,
    request: Request,
    first: Annotated[int, Query(ge=0, le=1_000_000_000, description="First frame.")] = 0,
    limit: Annotated[int, Query(ge=1, le=MOST_STATES, description="Maximum number of frames.")] = MOST_STATES,
    parts: Annotated[bool, Query(description="Include the current part labels of all Gaussians.")] = False,
) -> Response:
    """Returns committed frames as a compact 4D file, which `scas4d export` converts to other formats.

    Frames that the scene already stores in a compact file are copied unchanged. The response then ends where that file
    ends, and may start before the requested range, at the keyframe that the range depends on.
    """
    scene.committed_frame(None, "first")
    begin = bisect_left(scene.committed, first)
    frames = tuple(scene.committed[begin : begin + limit])
    if not frames:
        raise Problem(
            404,
            f"no committed frames from {first} on",
            field="first",
            value=first,
            remedy=f"use a frame from {scene.committed[0]} to {scene.committed[-1]}",
        )
    answer = await ask(request, scene, CompactQuery(frames, parts))
    after = bisect_right(scene.committed, int(answer.headers["X-Last-Frame"]))
    following = scene.committed[after : after + 1]
    headers = {**answer.headers, **({"X-Next-Frame": str(following[0])} if len(following) else {})}
    name = f"{scene.id[:8]}-{frames[0]:06d}.s4d"
    return immutable_response(request, answer.body, media_type=answer.media_type, name=name, headers=headers)


async def _stored(scene: Scene, n: int, c: str, kind: FileKind) -> memoryview:
    """Reads an image or mask from the frame log.

    Raises:
        Problem: 404 if it is missing or damaged.
    """
    if c not in scene.rig.names:
        raise Problem(404, f"the rig has no camera {c!r}", field="c", value=c, remedy=f"use one of {scene.rig.names}")
    entry = scene.ledger.frames.get(n)
    if entry is None:
        remedy = f"wait for it: the next frame is {scene.next_frame}"
        raise Problem(404, f"frame {n} has not arrived", field="n", value=n, remedy=remedy)
    field, fault = "n", f"the images of frame {n} are no longer stored"
    for name in entry.files:
        try:
            stored = await asyncio.to_thread(read_pictures, scene.spec.folder.frames, name)
        except FrameDamage as error:
            fault = f"the images of frame {n} cannot be read: {error}"
            continue
        if (picture := (stored.images if kind == FileKind.IMAGE else stored.masks).get(c)) is not None:
            return picture
        field, fault = "c", f"no {kind.value} of camera {c} was sent with frame {n}"
    remedy = "request a newer frame; to keep more images, change the scene's `keep_frames` with PATCH"
    raise Problem(404, fault, field=field, value=n if field == "n" else c, remedy=remedy)


def _media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def _media_type_problem(request: Request) -> Problem:
    return Problem(
        415,
        f"the body of a frame must be {FRAME_MEDIA_TYPE} or multipart/form-data",
        field="Content-Type",
        value=request.headers.get("content-type", ""),
        remedy="send one file per camera, named after the camera",
    )


@contextmanager
def _connected(what: str) -> Iterator[None]:
    """Raises `Problem` (400) if the sender closes the connection while it sends `what`."""
    try:
        yield
    except ClientDisconnect:
        raise Problem(400, "the sender closed the connection", field="body", remedy=f"send the {what} again") from None


def _length(request: Request) -> int | None:
    """Returns the Content-Length of the body in bytes, or None if it is absent or not a number."""
    length = request.headers.get("content-length")
    return None if length is None or not length.isdigit() else int(length)
