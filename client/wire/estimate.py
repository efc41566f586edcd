"""Memory and disk that a scene will take, before it is created."""

from __future__ import annotations

from pydantic import Field

from client.wire.base import Model


class SceneEstimate(Model):
    """Memory and disk, in MB of a million bytes; `docs/operations.md` has the formula and what was measured."""

    pixels: int = Field(description="Of all cameras together, as they are sent.")
    scaled_pixels: int = Field(description="The same after `settings.scene.image_scale`.")
    gaussians: int = Field(description="The budget of Gaussians; where frame 0 decides it, the most it may decide.")
    pictures_mb: float = Field(description="Pictures of a frame in the worker: cameras times pixels.")
    gaussians_mb: float = Field(description="All that an update keeps for each Gaussian.")
    worker_mb: float = Field(description="The process that updates, at its peak.")
    readers_mb: float = Field(description="The two processes that answer, without long histories.")
    memory_mb: float = Field(description="Together.")
    limit_mb: float = Field(description="What a scene may take on this service.")
    state_mb: float = Field(description="On disk for each committed frame.")
    history_mb: float = Field(description="In a reader for each frame of a query over all Gaussians.")
