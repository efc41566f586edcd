"""Frames on the wire: what was taken, and what became of it."""

from __future__ import annotations

from enum import StrEnum

from pydantic import Field

from client.wire.base import Model


class FrameReceipt(Model):
    """The frame was taken and will be reconstructed in its turn. The same frame again gets the same receipt."""

    scene: str
    index: int
    time: float = Field(description="Seconds.")
    identity: str = Field(description="SHA-256 over the sorted (camera, kind, SHA-256 of the file) and the time.")


class FrameState(StrEnum):
    """Where a frame is."""

    QUEUED = "queued"
    UPDATING = "updating"
    COMMITTED = "committed"
    SET_ASIDE = "set_aside"


class FrameReportModel(Model):
    """What became of a frame."""

    scene: str
    index: int
    time: float = Field(description="Seconds.")
    state: FrameState
    error: str | None = Field(default=None, description="Why the frame was set aside.")
    dropped_cameras: dict[str, str] = Field(default_factory=dict, description="Camera left out → reason.")
    iterations: int | None = None
    seconds: dict[str, float] = Field(default_factory=dict, description="By stage.")
    loss: list[float] = Field(default_factory=list)
    psnr: float | None = Field(default=None, description="dB, training views of the last iterations.")
    moving: int | None = None
    gaussians: int | None = None
