"""Part segmentation on the wire."""

from __future__ import annotations

from pydantic import Field

from client.wire.base import Model


class PartsModel(Model):
    """A part label for every Gaussian."""

    count: int
    ids: list[int] = Field(description="[N]")
    labels: list[int] = Field(description="[N] 0 … count−1; −1 for what stands still.")
