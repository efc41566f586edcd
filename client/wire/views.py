"""Wire models of novel views."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from client.wire.base import MAX_PIXELS_A_SIDE, Model
from client.wire.rigs import CameraModel


class RenderKind(StrEnum):
    """The type of image that a render request returns."""

    COLOUR = "colour"
    DEPTH = "depth"
    ALPHA = "alpha"
    PARTS = "parts"


class RenderFormat(StrEnum):
    """The image encoding of a render."""

    PNG = "png"
    JPEG = "jpeg"
    WEBP = "webp"
    NPZ = "npz"
    FLOAT32 = "float32"


Unit = Annotated[float, Field(ge=0, le=1)]


class RenderRequest(Model):
    """A request for a novel view."""

    camera: CameraModel | str
    """Any camera in the rig's world frame, or the name of a camera in the rig."""
    frame: int | None = Field(default=None, ge=0)
    """Index of a committed frame; default: the last one."""
    kinds: Annotated[list[RenderKind], Field(min_length=1, max_length=4)] = Field(
        default_factory=lambda: [RenderKind.COLOUR]
    )
    """Image files have one kind; npz and float32 may have several. Depth is measured along z in the rig's units, and is
    NaN where nothing is visible. As PNG, it has 16 bits: 0 for nothing, and 1…65535 from X-Depth-Near to X-Depth-Far.
    Parts are 0 for static Gaussians, otherwise 1 + label; as PNG, they have a palette.
    """
    format: RenderFormat = RenderFormat.PNG
    """JPEG and WebP support colour and alpha. float32 is little-endian, with rows from the top; X-Shape is
    'height,width,channels', and X-Channels names the channels.
    """
    width: int | None = Field(default=None, ge=1, le=MAX_PIXELS_A_SIDE)
    """Image width in pixels; the camera is scaled to this width, and the height in proportion."""
    quality: int | None = Field(default=None, ge=1, le=100)
    """Quality of JPEG and WebP; default: 92."""
    background: tuple[Unit, Unit, Unit] | None = None
    """RGB colour; default: the scene's background."""
    parts: int | None = Field(default=None, ge=1, le=254)
    """Number of parts; default: chosen by the scene."""
