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

ExportFormat = Literal["ply", "splat", "spz", "spz4", "glb", "glb-parts", "usd", "tracks", "poses", "tapvid-mv", "s4d"]
"""Format names from `scas4d_core.exports.FORMATS`, repeated here to avoid importing it."""
SUFFIXES: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("ply", "splat", "spz", "spz4", "glb"), ".zip"),
        "glb-parts": ".glb",
        "usd": ".usdc",
        "tracks": ".csv",
        "poses": ".csv",
        "tapvid-mv": ".zip",
        "s4d": ".s4d",
    }
)
"""File suffix of each format; numbered files are packed into a single .zip."""
WITH_IDS = ("tracks", "tapvid-mv")
"""Formats for which Gaussians can be selected by their ids."""
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

    format: ExportFormat
    """File format; docs/exports.md lists what each format preserves and loses."""
    first: FrameNumber | None = None
    """First frame; null for the first committed frame."""
    last: FrameNumber | None = None
    """Last frame, inclusive; null for the last committed frame."""
    ids: (
        Annotated[list[Annotated[int, Field(ge=0, le=LARGEST_ID)]], Field(min_length=1, max_length=MOST_IDS)] | None
    ) = None
    """Ids of the Gaussians to export as `tracks` or `tapvid-mv`; null for moving ones."""


class ExportModel(Model):
    """An export. It is kept until it is deleted, it expires, or the service stops."""

    id: str
    scene: str
    format: ExportFormat
    first: int
    """First exported frame."""
    last: int
    """Last exported frame."""
    state: ExportState
    done: int
    """Number of frames written so far."""
    frames: int
    """Number of frames in total."""
    bytes: int
    """Number of bytes on disk so far; the size of the file once the export is done."""
    error: str | None
    """Reason why the export failed or was cancelled."""
    created: str
    """Creation time, ISO 8601."""
    expires: str | None
    """Time at which the file will be removed; null until the export is done."""
    name: str
    """File name. Numbered files are packed into a single .zip."""
    file: str | None
    """Path of the file, relative to the service address; null until the export is done."""


class ExportList(Model):
    """The exports of a scene, oldest first."""

    exports: list[ExportModel]
