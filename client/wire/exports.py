"""Wire models of exports."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import Field

from client.wire.base import Model

MOST_IDS = 10_000
LARGEST_ID = 2**63 - 1
LAST_FRAME = 1_000_000_000

ExportFormat = Literal["ply", "splat", "spz", "spz4", "glb", "glb-parts", "usd", "tracks", "poses", "s4d"]
"""Names of the formats in `scas4d_core.exports.FORMATS`, repeated here to avoid that import."""
SUFFIXES: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("ply", "splat", "spz", "spz4", "glb"), ".zip"),
        "glb-parts": ".glb",
        "usd": ".usdc",
        "tracks": ".csv",
        "poses": ".csv",
        "s4d": ".s4d",
    }
)
"""File suffix of each format; numbered files are packed into one .zip."""
FrameNumber = Annotated[int, Field(strict=True, ge=0, le=LAST_FRAME)]


class ExportState(StrEnum):
    """State of an export."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class ExportRequest(Model):
    """A request to export a range of committed frames (see docs/exports.md)."""

    format: ExportFormat = Field(description="The format; docs/exports.md lists what each contains and loses.")
    first: FrameNumber | None = Field(default=None, description="First frame; null: the first committed frame.")
    last: FrameNumber | None = Field(default=None, description="Last frame, inclusive; null: the last committed frame.")
    ids: (
        Annotated[list[Annotated[int, Field(ge=0, le=LARGEST_ID)]], Field(min_length=1, max_length=MOST_IDS)] | None
    ) = Field(default=None, description="Gaussians for the format `tracks`; null: all moving Gaussians.")


class ExportModel(Model):
    """An export. The service keeps it until it is deleted, it expires, or the service stops."""

    id: str
    scene: str
    format: ExportFormat
    first: int = Field(description="First exported frame.")
    last: int = Field(description="Last exported frame.")
    state: ExportState
    done: int = Field(description="Number of frames written so far.")
    frames: int = Field(description="Number of frames in total.")
    bytes: int = Field(description="Bytes on disk so far; the size of the file once it is done.")
    error: str | None = Field(description="Why the export failed or was cancelled.")
    created: str = Field(description="Creation time, ISO 8601.")
    expires: str | None = Field(description="Time at which the file is removed; null until it is done.")
    name: str = Field(description="Name of the file. Numbered files are packed into one .zip.")
    file: str | None = Field(description="Path of the file relative to the service's address; null until it is done.")


class ExportList(Model):
    """The exports of a scene, oldest first."""

    exports: list[ExportModel]
