"""Base class and field types of the models on the wire."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from scas4d_core.cameras import CAMERA_NAME

MAX_CAMERAS = 512
MAX_PIXELS_A_SIDE = 16_384

CameraName = Annotated[
    str,
    Field(
        pattern=CAMERA_NAME,
        description="Letters, digits, dot, dash, underscore; not `time`, and not beginning with `mask.`.",
    ),
]
Row3 = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
Row4 = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
Pixel = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2)]


class Model(BaseModel):
    """Base of the models on the wire. An unknown field is an error, so that a misspelt one is noticed."""

    model_config = ConfigDict(extra="forbid")
