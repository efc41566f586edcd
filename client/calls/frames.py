"""Frames: sent whole, and what became of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from client.calls.call import Call, path, reads
from client.wire import FrameReceipt, FrameReportModel


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
    """
    files = {camera: (camera, data) for camera, data in images.items()}
    files |= {f"mask.{camera}": (f"mask.{camera}", data) for camera, data in (masks or {}).items()}
    arguments: dict[str, Any] = {"files": files}
    if time is not None:
        arguments["data"] = {"time": repr(float(time))}
    return Call("PUT", path(id, "frames", index), reads(FrameReceipt), arguments=arguments)


def frame(id: str, index: int) -> Call[FrameReportModel]:
    """What became of a frame."""
    return Call("GET", path(id, "frames", index), reads(FrameReportModel))


def ply(id: str, index: int) -> Call[bytes]:
    """A committed frame as a 3DGS .ply."""
    return Call("GET", path(id, "frames", index, "splat.ply"), lambda response: response.content)
