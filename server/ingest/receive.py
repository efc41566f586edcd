"""Bodies of requests and messages of WebSockets to frames of a scene: receive, check, write, acknowledge."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from typing import Any, TypeVar

from fastapi import Request
from starlette.datastructures import UploadFile

from client.wire import FileKind, FrameFile, FrameHead, FrameReceipt, PartReceipt
from scas4d_core.cameras import Camera
from server.ingest.acknowledge import whole
from server.ingest.pictures import MASK, check_files, check_picture, check_size
from server.ingest.upload import Received, Receiving, receive_framed
from server.problems import Problem, counted
from server.scene.scene import Scene
from server.storage.disk import full_disk, no_room

T = TypeVar("T")


async def take_framed(scene: Scene, index: int | None, body: AsyncIterator[bytes], length: int | None) -> FrameReceipt:
    """A whole frame as S4DF. `index` is that of the address, None where the head alone says it."""
    begun: list[int] = []

    def begin(head: FrameHead) -> Receiving:
        _agree(head, index)
        check_files(scene.rig, head.files, whole=True)
        keep = scene.ingest.expects(head)
        if keep:
            scene.ingest.coming(head.index)
            begun.append(head.index)
        return _receiving(scene, head, scene.ingest.time_of(head.index, head.time), keep)

    try:
        head, receiving = await receive_framed(_to_the_end(body), begin, length)
        return await _taken(scene, head, receiving)
    finally:
        for number in begun:
            scene.ingest.came(number)
        await _drain(body)


async def take_form(scene: Scene, index: int, request: Request) -> FrameReceipt:
    """A whole frame as multipart/form-data: as easy to send as it is slow to read."""
    # A picture sent as a plain field (no file name) would be read as text: such fields are kept short.
    async with request.form(max_files=2 * len(scene.rig) + 8, max_fields=8, max_part_size=4096) as form:
        given: dict[str, UploadFile] = {}
        time: float | None = None
        for name, value in form.multi_items():
            if name == "time" and isinstance(value, str):
                time = _seconds(value)
            elif isinstance(value, UploadFile):
                if name in given:
                    raise Problem(
                        422,
                        f"{name!r} is here twice",
                        field=name,
                        value=value.filename,
                        remedy="send one file a camera",
                    )
                given[name] = value
            else:
                raise Problem(
                    422, f"{name!r} is no file", field=name, value=value, remedy="send it with a file name in its part"
                )
        # Names that no camera can have are refused here, as the model of a file would not take them.
        for name in given:
            scene_camera(scene, name.removeprefix(MASK), name)
        head = _head(index, time, [_file(name, upload.size or 0) for name, upload in given.items()], part=False)
        check_files(scene.rig, head.files, whole=True)
        keep = scene.ingest.expects(head)
        if keep:
            scene.ingest.coming(index)
        try:
            receiving = _receiving(scene, head, scene.ingest.time_of(index, time), keep)
            await _feed(receiving, [await upload.read() for upload in given.values()])
            return await _taken(scene, head, receiving)
        finally:
            if keep:
                scene.ingest.came(index)


async def take_camera(
    scene: Scene, index: int | None, camera: str | None, body: AsyncIterator[bytes], length: int | None
) -> PartReceipt:
    """One camera's picture and mask as S4DF."""
    names: list[str] = []

    def begin(head: FrameHead) -> Receiving:
        _agree(head, index)
        check_files(scene.rig, head.files, whole=False)
        names.append(_one_camera(head, camera))
        scene.ingest.expects_part(head, names[0])
        return _receiving(scene, head.model_copy(update={"part": True}), head.time, head.index >= scene.next_frame)

    try:
        head, receiving = await receive_framed(_to_the_end(body), begin, length)
        return await _part_taken(scene, head, names[0], receiving)
    finally:
        await _drain(body)


async def take_file(
    scene: Scene,
    index: int,
    camera: str,
    kind: FileKind,
    time: float | None,
    body: AsyncIterator[bytes],
    length: int | None,
) -> PartReceipt:
    """One camera's picture or mask, the file as it is."""
    scene_camera(scene, camera, "c")
    data = await _read(scene.rig[camera], camera, body, length)
    head = _head(index, time, [FrameFile(camera=camera, kind=kind, size=len(data))], part=True)
    scene.ingest.expects_part(head, camera)
    receiving = _receiving(scene, head, time, index >= scene.next_frame)
    await _feed(receiving, [data])
    return await _part_taken(scene, head, camera, receiving)


async def _read(camera: Camera, field: str, body: AsyncIterator[bytes], length: int | None) -> bytearray:
    """A file of a camera; no more of it is kept than the camera's pictures can have."""
    data = bytearray()
    try:
        check_size(camera, field, length or 0)
        async for chunk in body:
            check_size(camera, field, len(data) + len(chunk))
            data += chunk
        return data
    finally:
        await _drain(body)


def scene_camera(scene: Scene, camera: str, field: str) -> None:
    """Refuses a camera that the rig does not have."""
    if camera not in scene.rig.names:
        raise Problem(
            422,
            f"the rig has no camera {camera!r}",
            field=field,
            value=camera,
            remedy=f"the cameras are {', '.join(scene.rig.names)}",
        )


def _head(index: int, time: float | None, files: Sequence[FrameFile], *, part: bool) -> FrameHead:
    if not files:
        raise Problem(
            422,
            "no picture is here",
            field="body",
            value="nothing",
            remedy="send one file a camera, named like the camera",
        )
    return FrameHead(index=index, time=time, files=list(files), part=part)


def _file(field: str, size: int) -> FrameFile:
    kind = FileKind.MASK if field.startswith(MASK) else FileKind.IMAGE
    return FrameFile(camera=field.removeprefix(MASK), kind=kind, size=size)


def _receiving(scene: Scene, head: FrameHead, seconds: float | None, keep: bool) -> Receiving:
    return Receiving(
        scene.spec.frames, head, seconds, lambda file, data: check_picture(scene.rig, file, data), keep=keep
    )


async def _feed(receiving: Receiving, files: Sequence[bytes | bytearray]) -> None:
    try:
        for data in files:
            await receiving.take(memoryview(data))
    except BaseException as error:
        await receiving.abort()
        if no_room(error) and isinstance(error, OSError):
            raise full_disk(error) from None
        raise


async def _taken(scene: Scene, head: FrameHead, receiving: Receiving) -> FrameReceipt:
    return await _kept_or_removed(receiving, lambda received: scene.ingest.take(head, received))


async def _part_taken(scene: Scene, head: FrameHead, camera: str, receiving: Receiving) -> PartReceipt:
    return await _kept_or_removed(receiving, lambda received: scene.ingest.take_part(head, camera, received))


async def _kept_or_removed(receiving: Receiving, take: Callable[[Received], Coroutine[Any, Any, T]]) -> T:
    """Completes even where the request is cancelled: a record that an event names, or will, must not be removed."""

    async def taken() -> T:
        received = await _finished(receiving)
        try:
            return await take(received)
        finally:
            if not received.kept:
                await receiving.abort()

    return await whole(taken())


async def _finished(receiving: Receiving) -> Received:
    try:
        return await receiving.finish()
    except BaseException as error:
        await receiving.abort()
        if no_room(error) and isinstance(error, OSError):
            raise full_disk(error) from None
        raise


async def _to_the_end(body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    async for chunk in body:
        yield chunk


async def _drain(body: AsyncIterator[bytes]) -> None:
    """Reads what is left of a body that is refused: a sender that is still sending would not see the answer."""
    async for _ in body:
        pass


def _agree(head: FrameHead, index: int | None) -> None:
    if index is not None and head.index != index:
        raise Problem(
            422,
            f"the head says frame {head.index}, the address frame {index}",
            field="head.index",
            value=head.index,
            remedy="send both alike",
        )


def _one_camera(head: FrameHead, camera: str | None) -> str:
    names = sorted({file.camera for file in head.files})
    if len(names) != 1 or camera not in (None, names[0]):
        raise Problem(
            422,
            f"the files are of {counted(len(names), 'camera')}: {', '.join(names)}",
            field="head.files",
            value=", ".join(names),
            remedy="send the files of one camera" + ("" if camera is None else f", {camera!r}, as the address says"),
        )
    return names[0]


def _seconds(value: str) -> float:
    try:
        seconds = float(value)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise Problem(
            422, "time is no finite number", field="time", value=value, remedy="give seconds, as 1.25, or leave it out"
        )
    return seconds
