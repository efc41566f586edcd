"""Wire model of a scene's estimated memory and disk usage."""

from __future__ import annotations

from pydantic import Field

from client.wire.base import Model


class SceneEstimate(Model):
    """Estimated memory and disk usage in MB (10⁶ bytes); `docs/operations.md` documents the formula."""

    pixels: int = Field(description="Pixels of all cameras together, as sent.")
    scaled_pixels: int = Field(description="Pixels of all cameras after `settings.scene.image_scale`.")
    gaussians: int = Field(
        description="Maximum number of Gaussians. If frame 0 chooses the number, this is its upper limit."
    )
    pictures_mb: float = Field(
        description="Memory of one frame's pictures in the worker, proportional to cameras × pixels."
    )
    gaussians_mb: float = Field(description="Memory that an update needs for its Gaussians.")
    worker_mb: float = Field(description="Peak memory of the worker process.")
    readers_mb: float = Field(description="Memory of the two reader processes, without queries over many frames.")
    memory_mb: float = Field(description="Memory of all processes of the scene.")
    limit_mb: float = Field(description="Memory limit per scene on this service.")
    state_mb: float = Field(description="Disk space per exact state; older states take a twentieth.")
    history_mb: float = Field(description="Memory of a reader per frame of a query over all Gaussians.")
