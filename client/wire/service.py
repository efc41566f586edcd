"""The service itself on the wire: health, errors."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from client.wire.base import Model


class Health(Model):
    """The service answers."""

    status: Literal["live", "ready"]
    version: str
    scenes: int


class ProblemDetails(BaseModel):
    """RFC 9457. `field`, `value` and `remedy` are ours: what was wrong, with which value, and what to do."""

    model_config = ConfigDict(extra="allow")

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    field: str | None = None
    value: str | None = None
    remedy: str | None = None
