"""Reconstructions of a scene on the wire: the first comes with the scene, each further one is asked for."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from client.wire.base import Model


class ReconstructionRequest(Model):
    """How to begin the reconstruction of a scene anew, from its first frame on, in place of the one before."""

    settings: dict[str, Any] = Field(
        default_factory=dict, description="What changes of the scene's settings, nested, as when a scene is created."
    )
    frame: int | None = Field(
        default=None,
        ge=0,
        le=1_000_000_000,
        description="The frame to begin with, here or still to come; null: as before. Those before it are set aside.",
    )
    points: bool = Field(
        default=True,
        description="Begin from the scene's points, the newest that were sent; false: from the pictures alone.",
    )
    discard: bool = Field(
        default=False, description="Drop committed states; must be true where a frame after the first is committed."
    )
