"""Calls on frames: send whole or camera by camera, close, declare missing, read reports and exports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from client.calls.call import Call, body, json_reader, path
from client.wire import (
    FRAME_MEDIA_TYPE,
    CameraReceipt,
    FileKind,
    FrameReceipt,
    FrameReportModel,
    MissingRequest,
    frame_chunks,
)
from client.wire.frames import FrameList


def put_frame(
    id: str,
    index: int,
    images: Mapping[str, bytes],
    masks: Mapping[str, bytes] | None = None,
    time: float | None = None,
) -> Call[FrameReceipt]:
    """Sends frame `index` whole. Waits while the queue is full.

    Args:
        id: of the scene.
        index: 0, 1, 2, …
        images: JPEG, PNG or WebP files by camera name, all cameras of the rig.
        masks: PNG files by camera name, of all cameras or none.
        time: seconds, rising from frame to frame; index / frames_per_second where not given.

    Raises:
        FrameGap: `expected` is the index that comes next.
        Conflict: the index is known with other content.

    >>> n = client.scene(open_scene).next_frame
    >>> client.put_frame(open_scene, n, pictures).index == n
    True
    >>> client.wait(open_scene, n).state
    <FrameState.COMMITTED: 'committed'>
    """
    arguments = _framed(index, images, masks or {}, time)
    return Call("PUT", path(id, "frames", index), json_reader(FrameReceipt), arguments=arguments)


def put_camera(
    id: str, index: int, camera: str, image: bytes, mask: bytes | None = None, time: float | None = None
) -> Call[CameraReceipt]:
    """Sends one camera's picture of frame `index`, where each camera has its own sender.

    The frame closes when all cameras are in, on `close_frame`, or after the scene's `ingest.open_frame_seconds`. A
    camera may be some frames ahead of the others.

    Args:
        id: of the scene.
        index: of the frame.
        camera: of the rig.
        image: JPEG, PNG or WebP.
        mask: PNG.
        time: seconds of the frame, the same for all its cameras.

    >>> n = client.scene(open_scene).next_frame
    >>> client.put_camera(open_scene, n, "c0", pictures["c0"]).absent
    ['c1']
    >>> client.put_camera(open_scene, n, "c1", pictures["c1"]).absent
    []
    """
    arguments = _framed(index, {camera: image}, {} if mask is None else {camera: mask}, time, part=True)
    return Call("PUT", path(id, "frames", index, "cameras", camera), json_reader(CameraReceipt), arguments=arguments)


def close_frame(id: str, index: int) -> Call[FrameReceipt]:
    """Closes a frame whose cameras send one by one: it is reconstructed without those that are absent.

    >>> n = client.scene(open_scene).next_frame
    >>> client.put_camera(open_scene, n, "c0", pictures["c0"]).absent
    ['c1']
    >>> client.close_frame(open_scene, n).index == n
    True
    """
    return Call("POST", path(id, "frames", index, "close"), json_reader(FrameReceipt))


def declare_missing(id: str, index: int, reason: str = "") -> Call[FrameReportModel]:
    """Declares that frame `index`, which is next, will never come; for ever. The one after it is next then.

    >>> n = client.scene(open_scene).next_frame
    >>> client.declare_missing(open_scene, n, "cable").state
    <FrameState.MISSING: 'missing'>
    >>> client.scene(open_scene).next_frame == n + 1
    True
    """
    arguments = body(MissingRequest(reason=reason))
    return Call("POST", path(id, "frames", index, "missing"), json_reader(FrameReportModel), arguments=arguments)


def _framed(
    index: int, images: Mapping[str, bytes], masks: Mapping[str, bytes], time: float | None, *, part: bool = False
) -> dict[str, Any]:
    content = b"".join(frame_chunks(index, images, masks, time, part=part))
    return {"content": content, "headers": {"Content-Type": FRAME_MEDIA_TYPE}}


def frame(id: str, index: int) -> Call[FrameReportModel]:
    """Reads the report of a frame.

    >>> report = client.frame(scene, 1)
    >>> report.state, report.used_cameras
    (<FrameState.COMMITTED: 'committed'>, ['c0', 'c1'])
    """
    return Call("GET", path(id, "frames", index), json_reader(FrameReportModel))


def frames(id: str, first: int = 0, limit: int = 500) -> Call[FrameList]:
    """Reads the reports of many frames, from `first` on; `next` of the answer is the index to go on with.

    >>> listed = client.frames(scene, limit=1)
    >>> [report.index for report in listed.frames], listed.next
    ([0], 1)
    """
    arguments = {"params": {"first": first, "limit": limit}}
    return Call("GET", path(id, "frames"), json_reader(FrameList), arguments=arguments)


def ply(id: str, index: int) -> Call[bytes]:
    """Reads a committed frame as a 3DGS .ply.

    >>> client.ply(scene, 1)[:3]
    b'ply'
    """
    return Call("GET", path(id, "frames", index, "splat.ply"), lambda response: response.content)


def states(id: str, first: int = 0, limit: int = 120, parts: bool = False) -> Call[tuple[bytes, int | None]]:
    """Reads committed frames from `first` on as a compact 4D file, and the frame to go on with, or None.

    The file may start before the requested range, at the key frame that it depends on.

    >>> data, following = client.states(scene)
    >>> data[:4], following
    (b's4dR', None)
    """

    def read(response: Any) -> tuple[bytes, int | None]:
        following = response.headers.get("X-Next-Frame")
        return response.content, None if following is None else int(following)

    arguments = {"params": {"first": first, "limit": limit, "parts": parts}}
    return Call("GET", path(id, "states.s4d"), read, arguments=arguments)


def picture(id: str, index: int, camera: str, kind: FileKind = FileKind.IMAGE) -> Call[bytes]:
    """Reads one camera's picture of a frame, or its mask, byte for byte as it was sent.

    >>> client.picture(scene, 1, "c0")[1:4]
    b'PNG'
    """
    arguments = {"params": {"kind": kind.value}}
    return Call(
        "GET", path(id, "frames", index, "cameras", camera), lambda response: response.content, arguments=arguments
    )
