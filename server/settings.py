"""Settings of the service. Each can be given by the environment as SCAS4D_<NAME>."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field


class ServerSettings(BaseModel):
    """What the one who runs the service may choose."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    data: Path = Field(default=Path("data"), description="Folder of the scenes; made when missing.")
    engine: str = Field(
        default="server.engine:core_engine",
        description="module:function that makes the engine of a scene, called once in each of its processes.",
    )
    max_scenes: int = Field(default=8, ge=1, description="Each holds two processes and some hundred megabytes.")
    queue_frames: int = Field(
        default=4, ge=1, description="Frames of a scene acknowledged and not finished; more get 429."
    )
    max_body_mb: float = Field(default=256, gt=0, description="Largest request body: 64 cameras of 4 MB.")
    max_image_pixels: int = Field(
        default=40_000_000,
        ge=1,
        description="Of one camera; a decoded picture takes 3 bytes a pixel, twice while decoding.",
    )
    max_points: int = Field(default=2_000_000, ge=1, description="Of an initial cloud.")
    max_render_pixels: int = Field(default=8_000_000, ge=1, description="Of one novel view.")
    max_track_points: int = Field(default=1_000_000, ge=1, description="Points times frames of one track query.")
    max_subscribers: int = Field(default=128, ge=1, description="Of the stream of one scene.")
    max_subscriptions: int = Field(default=16, ge=1, description="Of one subscriber at a time.")
    max_stream_message_kb: int = Field(
        default=256, ge=1, description="Largest message of a subscriber: some 8000 pixels to track."
    )
    stream_questions: int = Field(
        default=2,
        ge=1,
        description="Views, tracks and parts for subscribers that a scene's reader has before it at a time; more wait.",
    )
    answer_seconds: float = Field(
        default=120.0, gt=0, description="A render, track or part query that takes longer gets 503."
    )
    stop_seconds: float = Field(
        default=5.0, gt=0, description="Grace for a worker to end by itself at shutdown and delete."
    )

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] | None = None, **given: object) -> ServerSettings:
        """The defaults, overridden by the environment, overridden by what is given (None counts as not given)."""
        environment = os.environ if environment is None else environment
        read = {
            name: environment[f"SCAS4D_{name.upper()}"]
            for name in cls.model_fields
            if f"SCAS4D_{name.upper()}" in environment
        }
        return cls.model_validate(read | {name: value for name, value in given.items() if value is not None})
