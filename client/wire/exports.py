"""Exports of a scene that the service makes, on the wire."""

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
"""Names of `scas4d_core.exports.FORMATS`, which neither the service nor the page imports."""
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
"""Suffix of the file by format; numbered files come in one .zip."""
FrameNumber = Annotated[int, Field(strict=True, ge=0, le=LAST_FRAME)]


class ExportState(StrEnum):
    """State of an export."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


class ExportRequest(Model):
    """A request for an export: the committed frames of a range in the format of another tool (docs/exports.md)."""

    format: ExportFormat = Field(description="docs/exports.md has what each holds, and what is lost.")
    first: FrameNumber | None = Field(default=None, description="First frame; null: the first committed one.")
    last: FrameNumber | None = Field(default=None, description="Last frame, included; null: the last committed one.")
    ids: (
        Annotated[list[Annotated[int, Field(ge=0, le=LARGEST_ID)]], Field(min_length=1, max_length=MOST_IDS)] | None
    ) = Field(default=None, description="Gaussians of format `tracks`; null: all that move.")


class ExportModel(Model):
    """An export. It is kept in memory and on disk until it is removed, `expires`, or the service ends."""

    id: str
    scene: str
    format: ExportFormat
    first: int = Field(description="First frame that it has.")
    last: int = Field(description="Last frame that it has.")
    state: ExportState
    done: int = Field(description="Frames that are written.")
    frames: int = Field(description="Frames in all.")
    bytes: int = Field(description="On disk so far; of the file, once it is done.")
    error: str | None = Field(description="Why it failed or was cancelled.")
    created: str = Field(description="Time, ISO 8601.")
    expires: str | None = Field(description="Time at which its file is removed; null while it is made.")
    name: str = Field(description="Of the file. Numbered files come in one .zip.")
    file: str | None = Field(description="Path of the file below the address of the service; null until it is done.")


class ExportList(Model):
    """The exports of a scene, oldest first."""

    exports: list[ExportModel]
