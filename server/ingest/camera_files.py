"""Receivers of frames that are not sent as one S4DF body: multipart forms and single-camera uploads."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Sequence

from fastapi import Request
from starlette.datastructures import UploadFile

from client.wire import CameraReceipt, FileKind, FrameFile, FrameHead, FrameReceipt
from scas4d_core.cameras import Camera, Rig
from server.ingest.acknowledge import Ingest
from server.ingest.open_frames import OpenFrames
from server.ingest.pictures import MASK, check_files, check_size
from server.ingest.receive import FrameReceiver, accept_or_remove, check_index, drain, frame_receiver, read_framed
from server.problems import Problem, count_noun
from server.storage.disk import full_disk, no_room


async def receive_form(ingest: Ingest, index: int, request: Request) -> FrameReceipt:
    """Receives a complete frame as multipart/form-data, which is easy to send but slow to parse."""
    # An image sent as a plain field (without a file name) would be parsed as text, so plain fields have a size limit.
    async with request.form(max_files=2 * len(ingest.rules.rig) + 8, max_fields=8, max_part_size=4096) as form:
        given: dict[str, UploadFile] = {}
        time: float | None = None
        for name, value in form.multi_items():
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
            _check_camera(ingest.rules.rig, name.removeprefix(MASK), name)
        head = _head(index, time, [_file(name, upload.size or 0) for name, upload in given.items()], part=False)
        check_files(ingest.rules.rig, head.files, whole=True)
        keep = ingest.needs_files(head)
        if keep:
            ingest.begin_receiving(index)
        try:
            receiving = frame_receiver(ingest, head, ingest.time_of(index, time), keep=keep)
            await _receive_files(receiving, [await upload.read() for upload in given.values()])
            return await accept_or_remove(receiving, lambda received: ingest.accept(head, received))
        finally:
            if keep:
                ingest.end_receiving(index)


async def receive_camera(
    frames: OpenFrames, index: int | None, camera: str | None, body: AsyncIterator[bytes], length: int | None
) -> CameraReceipt:
    """Receives the image and mask of one camera as S4DF.

    `index` and `camera` are taken from the URL and are None if the URL does not contain them.
    """
    ingest = frames.ingest
    names: list[str] = []

    def begin(head: FrameHead) -> FrameReceiver:
        check_index(head, index)
        check_files(ingest.rules.rig, head.files, whole=False)
        names.append(_only_camera(head, camera))
        frames.check_head(head, names[0])
        keep = head.index >= ingest.ledger.next_frame
        return frame_receiver(ingest, head.model_copy(update={"single_camera": True}), head.time, keep=keep)

    try:
        head, receiving = await read_framed(body, begin, length)
        return await accept_or_remove(receiving, lambda received: frames.accept(head, names[0], received))
    finally:
        await drain(body)


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
    _check_camera(ingest.rules.rig, camera, "c")
    data = await _read(ingest.rules.rig[camera], camera, body, length)
    head = _head(index, time, [FrameFile(camera=camera, kind=kind, size=len(data))], part=True)
    frames.check_head(head, camera)
    receiving = frame_receiver(ingest, head, time, keep=index >= ingest.ledger.next_frame)
    await _receive_files(receiving, [data])
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


def _check_camera(rig: Rig, camera: str, field: str) -> None:
    """Raises `Problem` (422) if the camera is not in the rig."""
    if camera not in rig.names:
        raise Problem(
            422,
            f"the rig has no camera {camera!r}",
            field=field,
            value=camera,
            remedy=f"use one of {', '.join(rig.names)}",
        )


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


async def _receive_files(receiving: FrameReceiver, files: Sequence[bytes | bytearray]) -> None:
    try:
        for data in files:
            await receiving.take(memoryview(data))
    except BaseException as error:
        await receiving.abort()
        if no_room(error) and isinstance(error, OSError):
            raise full_disk(error) from None
        raise


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
        seconds = float(value)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise Problem(
            422,
            "time must be a finite number",
            field="time",
            value=value,
            remedy="use seconds, such as 1.25, or omit time",
        )
    return seconds
