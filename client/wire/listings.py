"""Reports of many frames at once, on the wire."""

from __future__ import annotations

from pydantic import Field

from client.wire.base import Model
from client.wire.frames import FrameReportModel


class FrameList(Model):
    """Frames in the order of their indices, without their losses and curves."""

    frames: list[FrameReportModel]
    next: int | None = Field(description="Where to go on: `first` of the next request; null where that was all.")
