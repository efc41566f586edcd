"""Receivers of frames that are not sent as one S4DF body: multipart forms and single-camera uploads."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence

from fastapi import Request
from starlette.datastructures import UploadFile

from client.wire import CameraReceipt, FileKind, FrameFile, FrameHead, FrameReceipt
from scas4d_core.cameras import Camera, Rig
from scas4d_core.errors import InputError
from scas4d_core.frame_times import check_time, time_error
from server.ingest.acknowledge import Ingest
from server.ingest.open_frames import OpenFrames
from server.ingest.pictures import MASK, check_camera, check_files, check_size
from server.ingest.receive import (
    BodyReader,
    accept_or_remove,
    check_index,
    check_length,
    drain,
    frame_receiver,
    in_one_piece,
    read_files,
    read_head,
    receive_files,
)
from server.problems import Problem, count_noun

FormFields = list[tuple[str, UploadFile | str]]
"""Names and values of the fields of a form, in order."""


async def receive_form(ingest: Ingest, index: int, request: Request) -> FrameReceipt:
    """Receives a complete frame as multipart/form-data, which is easy to send but slow to parse."""
    async with request.form(**form_limits(ingest.rules.rig, frames=1)) as form:
        head, uploads = form_frame(ingest.rules.rig, index, form.multi_items())
        return await receive_files(ingest, head, BodyReader(contents(uploads)), ends_body=False)


def form_limits(rig: Rig, frames: int) -> dict[str, int]:
    """Returns the limits of a form with up to `frames` frames, as keyword arguments of `Request.form`.

    An image sent as a plain field (without a file name) would be parsed as text, so plain fields have a size limit.
    """
    return {"max_files": frames * (2 * len(rig) + 8), "max_fields": 8 * frames, "max_part_size": 4096}


def form_frame(rig: Rig, index: int, fields: FormFields) -> tuple[FrameHead, list[UploadFile]]:
    """Returns the header and the files of a frame that is sent as form fields.

    Raises:
        Problem: 422 if a field is not the time, an image or a mask of one of the rig's cameras.
    """
    given: dict[str, UploadFile] = {}
    time: float | None = None
    for name, value in fields:
        if name == "time" and isinstance(value, str):
            time = _seconds(value)
        elif isinstance(value, UploadFile):
            if name in given:
                raise Problem(
                    422,
                    f"duplicate file {name!r}",
                    field=name,
                    value=value.filename,
                    remedy="send one image and at most one mask per camera",
                )
            given[name] = value
        else:
            raise Problem(
                422,
                f"{name!r} must be a file",
                field=name,
                value=value,
                remedy="send it as a form field with a file name",
            )
    # Checked before creating a `FrameFile`, whose validation would raise for an invalid camera name.
    for name in given:
        check_camera(rig, name.removeprefix(MASK), name)
    head = _head(index, time, [_file(name, upload.size or 0) for name, upload in given.items()], part=False)
    return head, list(given.values())


async def contents(uploads: Sequence[UploadFile]) -> AsyncIterator[bytes]:
    """Yields the contents of uploaded files."""
    for upload in uploads:
        yield await upload.read()


async def receive_camera(
    frames: OpenFrames, index: int | None, camera: str | None, body: AsyncIterator[bytes], length: int | None
) -> CameraReceipt:
    """Receives the image and mask of one camera as S4DF.

    `index` and `camera` are taken from the URL and are None if the URL does not contain them.
    """
    ingest, reader = frames.ingest, BodyReader(body)
    try:
        head = await read_head(reader)
        check_length(head, reader.position, length)
        check_index(head, index)
        check_files(ingest.rules.rig, head.files, whole=False)
        name = _only_camera(head, camera)
        frames.check_head(head, name)
        keep = head.index >= ingest.ledger.next_frame
        receiving = frame_receiver(ingest, head.model_copy(update={"single_camera": True}), head.time, keep=keep)
        await read_files(reader, receiving, ends_body=True)
        return await accept_or_remove(receiving, lambda received: frames.accept(head, name, received))
    finally:
        await reader.drain()


async def receive_file(
    frames: OpenFrames,
    index: int,
    camera: str,
    kind: FileKind,
    time: float | None,
    body: AsyncIterator[bytes],
    length: int | None,
) -> CameraReceipt:
    """Receives the image or mask of one camera as a plain file."""
    ingest = frames.ingest
    check_camera(ingest.rules.rig, camera, "c")
    data = await _read(ingest.rules.rig[camera], camera, body, length)
    head = _head(index, time, [FrameFile(camera=camera, kind=kind, size=len(data))], part=True)
    frames.check_head(head, camera)
    receiving = frame_receiver(ingest, head, time, keep=index >= ingest.ledger.next_frame)
    await read_files(BodyReader(in_one_piece(data)), receiving, ends_body=True)
    return await accept_or_remove(receiving, lambda received: frames.accept(head, camera, received))


async def _read(camera: Camera, field: str, body: AsyncIterator[bytes], length: int | None) -> bytearray:
    """Reads a camera's file, and refuses it as soon as it exceeds the maximum size for that camera."""
    data = bytearray()
    try:
        check_size(camera, field, length or 0)
        async for chunk in body:
            check_size(camera, field, len(data) + len(chunk))
            data += chunk
        return data
    finally:
        await drain(body)


def _head(index: int, time: float | None, files: Sequence[FrameFile], *, part: bool) -> FrameHead:
    if not files:
        raise Problem(
            422,
            "the frame contains no images",
            field="body",
            value="nothing",
            remedy="send one file per camera, with the camera's name as its field name",
        )
    return FrameHead(index=index, time=time, files=list(files), single_camera=part)


def _file(field: str, size: int) -> FrameFile:
    kind = FileKind.MASK if field.startswith(MASK) else FileKind.IMAGE
    return FrameFile(camera=field.removeprefix(MASK), kind=kind, size=size)


def _only_camera(head: FrameHead, camera: str | None) -> str:
    names = sorted({file.camera for file in head.files})
    if len(names) != 1 or camera not in (None, names[0]):
        raise Problem(
            422,
            f"expected files from one camera, got files from {count_noun(len(names), 'camera')}: {', '.join(names)}",
            field="head.files",
            value=", ".join(names),
            remedy="send only files from one camera" + ("" if camera is None else f", {camera!r}, as in the URL"),
        )
    return names[0]


def _seconds(value: str) -> float:
    try:
        return check_time(float(value))
    except ValueError as fault:
        error = fault if isinstance(fault, InputError) else time_error(value)
        raise Problem(422, error.fault, field="time", value=value, remedy=error.remedy) from None
