"""Wire model of a scene's estimated memory and disk usage."""

from __future__ import annotations

from client.wire.base import Model


class SceneEstimate(Model):
    """Estimated memory and disk usage in MB (10⁶ bytes); `docs/operations.md` documents the formula."""

    pixels: int
    """Total number of pixels of all cameras, as sent."""
    scaled_pixels: int
    """Total number of pixels of all cameras after scaling by `settings.scene.image_scale`."""
    gaussians: int
    """Maximum number of Gaussians. If the number is chosen in frame 0, this is its upper limit."""
    pictures_mb: float
    """Worker memory for the images of one frame, proportional to cameras × pixels."""
    gaussians_mb: float
    """Memory for the Gaussians during an update."""
    worker_mb: float
    """Peak memory of the worker process."""
    readers_mb: float
    """Memory of the two reader processes, excluding queries over many frames."""
    memory_mb: float
    """Total memory of all processes of the scene."""
    gpu_mb: float
    """GPU memory of the worker and of the reader that renders views, if the scene runs on a GPU; 0 for `device: cpu`.
    """
    limit_mb: float
    """Memory limit per scene on this service."""
    state_mb: float
    """Disk space per exact state; older states take a twentieth of it."""
    history_mb: float
    """Reader memory per frame for a query over all Gaussians."""
