"""Calls for frames: uploading (whole or per camera), closing, declaring missing, reporting and downloading."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from client.calls.call import Call, body, json_reader, path
from client.wire import (
    FRAME_MEDIA_TYPE,
    CameraReceipt,
    FileKind,
    FrameBatch,
    FrameReceipt,
    FrameReportModel,
    MissingRequest,
    frame_chunks,
)
from client.wire.frames import FrameList

Numbering = Literal["given", "next"]
OnRefusal = Literal["skip", "stop"]


@dataclass(frozen=True)
class NewFrame:
    """A frame to send in a batch.

    Attributes:
        index: frame index; ignored with `numbering="next"`.
        images: JPEG, PNG, WebP, BMP, PPM or PGM file of each camera, keyed by camera name.
        masks: PNG or BMP mask of each camera, keyed by camera name; empty for no masks.
        time: timestamp in seconds; index / frames_per_second if None.
    """

    index: int
    images: Mapping[str, bytes]
    masks: Mapping[str, bytes] = field(default_factory=dict)
    time: float | None = None

    def chunks(self) -> list[bytes]:
        """Returns the frame as S4DF, without copying the files."""
        return frame_chunks(self.index, self.images, self.masks, self.time)


def put_frame(
    id: str,
    index: int,
    images: Mapping[str, bytes],
    masks: Mapping[str, bytes] | None = None,
    time: float | None = None,
) -> Call[FrameReceipt]:
    """Sends a frame with the images of all cameras; waits while the queue is full.

    Args:
        id: scene id.
        index: frame index: 0, 1, 2, …
        images: JPEG, PNG, WebP, BMP, PPM or PGM file of each camera, keyed by camera name.
        masks: PNG or BMP mask of each camera, keyed by camera name; required for all cameras or none.
        time: timestamp in seconds, increasing from frame to frame; index / frames_per_second if None.

    Raises:
        FrameGap: another frame must be sent first; its index is `expected`.
        Conflict: the frame was already sent with different content.

    >>> n = client.scene(open_scene).next_frame
    >>> client.put_frame(open_scene, n, pictures).index == n
    True
    >>> client.wait(open_scene, n).state
    <FrameState.COMMITTED: 'committed'>
    """
    arguments = _framed(frame_chunks(index, images, masks, time))
    return Call("PUT", path(id, "frames", index), json_reader(FrameReceipt), arguments=arguments)


def put_frames(
    id: str, frames: Sequence[NewFrame], numbering: Numbering = "given", on_refusal: OnRefusal = "skip"
) -> Call[FrameBatch]:
    """Sends a batch of frames in one request and returns one answer per frame, in order.

    A frame that is refused because of its content does not stop the batch; its answer contains the problem. With
    `numbering="given"`, a frame refused with 413 or 422 is declared missing if the batch continues with the next index.
    With `on_refusal="stop"`, it ends the batch instead, and can be sent again without the images that were refused.

    Frames for which the queue had no room are sent again automatically. A batch should therefore be smaller than the
    scene's `ingest.queue_frames`; otherwise, its last frames are transferred several times.

    Args:
        id: scene id.
        frames: the frames, in order.
        numbering: "given" if the frames have their own indices; "next" to assign the next free indices, which requires
            a time for each frame.
        on_refusal: "skip" to continue after a frame whose content is refused; "stop" to end the batch there, so that
            all further frames get the same answer.

    Raises:
        Busy: the queue has no room for the first frame.

    >>> n = client.scene(open_scene).next_frame
    >>> batch = [
    ...     calls.NewFrame(n, pictures),
    ...     calls.NewFrame(n + 1, {"c0": b"damaged", "c1": b"damaged"}),
    ...     calls.NewFrame(n + 2, pictures),
    ... ]
    >>> [answer.status for answer in client.put_frames(open_scene, batch)]
    [202, 422, 202]
    >>> client.frame(open_scene, n + 1).state
    <FrameState.MISSING: 'missing'>
    """
    params = {"numbering": numbering, "on_refusal": on_refusal}
    arguments = {**_framed(chunk for frame in frames for chunk in frame.chunks()), "params": params}
    return Call("POST", path(id, "frames"), json_reader(FrameBatch), arguments=arguments)


def put_camera(
    id: str, index: int, camera: str, image: bytes, mask: bytes | None = None, time: float | None = None
) -> Call[CameraReceipt]:
    """Sends one camera's image of a frame, for rigs in which each camera has its own sender.

    The frame closes when all cameras have arrived, on `close_frame`, or after the scene's `ingest.open_frame_seconds`.
    A camera may be a few frames ahead of the others.

    Args:
        id: scene id.
        index: frame index.
        camera: name of a camera in the rig.
        image: contents of a JPEG, PNG, WebP, BMP, PPM or PGM file.
        mask: contents of a PNG file; None for no mask.
        time: timestamp of the frame in seconds; must be the same for all its cameras.

    >>> n = client.scene(open_scene).next_frame
    >>> client.put_camera(open_scene, n, "c0", pictures["c0"]).absent
    ['c1']
    >>> client.put_camera(open_scene, n, "c1", pictures["c1"]).absent
    []
    """
    masks = None if mask is None else {camera: mask}
    arguments = _framed(frame_chunks(index, {camera: image}, masks, time, part=True))
    return Call("PUT", path(id, "frames", index, "cameras", camera), json_reader(CameraReceipt), arguments=arguments)


def close_frame(id: str, index: int) -> Call[FrameReceipt]:
    """Closes a frame that is sent camera by camera, so that it is reconstructed without the absent cameras.

    >>> n = client.scene(open_scene).next_frame
    >>> client.put_camera(open_scene, n, "c0", pictures["c0"]).absent
    ['c1']
    >>> client.close_frame(open_scene, n).index == n
    True
    """
    return Call("POST", path(id, "frames", index, "close"), json_reader(FrameReceipt))


def declare_missing(id: str, index: int, reason: str = "") -> Call[FrameReportModel]:
    """Declares the next expected frame, `index`, permanently missing, so that the scene continues without it.

    >>> n = client.scene(open_scene).next_frame
    >>> client.declare_missing(open_scene, n, "cable").state
    <FrameState.MISSING: 'missing'>
    >>> client.scene(open_scene).next_frame == n + 1
    True
    """
    arguments = body(MissingRequest(reason=reason))
    return Call("POST", path(id, "frames", index, "missing"), json_reader(FrameReportModel), arguments=arguments)


def _framed(chunks: Iterable[bytes]) -> dict[str, Any]:
    """Returns the request arguments that send S4DF."""
    return {"content": b"".join(chunks), "headers": {"Content-Type": FRAME_MEDIA_TYPE}}


def frame(id: str, index: int) -> Call[FrameReportModel]:
    """Returns a frame's report.

    >>> report = client.frame(scene, 1)
    >>> report.state, report.used_cameras
    (<FrameState.COMMITTED: 'committed'>, ['c0', 'c1'])
    """
    return Call("GET", path(id, "frames", index), json_reader(FrameReportModel))


def frames(id: str, first: int = 0, limit: int = 500) -> Call[FrameList]:
    """Returns the reports of up to `limit` frames from `first` on; `next` is the value of `first` for the next page.

    >>> listed = client.frames(scene, limit=1)
    >>> [report.index for report in listed.frames], listed.next
    ([0], 1)
    """
    arguments = {"params": {"first": first, "limit": limit}}
    return Call("GET", path(id, "frames"), json_reader(FrameList), arguments=arguments)


def ply(id: str, index: int) -> Call[bytes]:
    """Returns a committed frame as a 3DGS .ply file.

    >>> client.ply(scene, 1)[:3]
    b'ply'
    """
    return Call("GET", path(id, "frames", index, "splat.ply"), lambda response: response.content)


def states(id: str, first: int = 0, limit: int = 120, parts: bool = False) -> Call[tuple[bytes, int | None]]:
    """Returns a compact 4D file of committed frames from `first` on, and the next frame to request, or None at the end.

    The file may start before the requested range, at the keyframe on which the range depends.

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
    """Returns one camera's image or mask of a frame, byte-for-byte as sent.

    >>> client.picture(scene, 1, "c0")[1:4]
    b'PNG'
    """
    arguments = {"params": {"kind": kind.value}}
    return Call(
        "GET", path(id, "frames", index, "cameras", camera), lambda response: response.content, arguments=arguments
    )
