"""`Call`: a request as a value; paths, bodies and readers of answers that most calls share."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar
from urllib.parse import quote

import httpx
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel

from client.wire import CameraModel
from scas4d_core.cameras import Camera

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

NPZ = "application/vnd.numpy.npz"


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request.

    Attributes:
        method: of HTTP.
        path: below the address of the service.
        parse: the answer to what the caller gets.
        repeatable: sending it twice does what sending it once does, so a client may try again.
        arguments: further ones of `httpx.Client.request`.
    """

    method: str
    path: str
    parse: Callable[[httpx.Response], T]
    repeatable: bool = True
    arguments: dict[str, Any] = field(default_factory=dict)


def path(*parts: str | int) -> str:
    """A path below /v1/scenes; each part is quoted."""
    return "/".join(["/v1/scenes", *(quote(str(part), safe="") for part in parts)])


def json_reader(model: type[M]) -> Callable[[httpx.Response], M]:
    """A reader of the answer's JSON as a model of the wire."""
    return lambda response: model.model_validate_json(response.content)


def nothing(response: httpx.Response) -> None:
    """Reads nothing: for answers without a body."""


def body(model: BaseModel) -> dict[str, Any]:
    """A model of the wire as the request's JSON; what was not set is left out."""
    return {"json": model.model_dump(mode="json", exclude_unset=True)}


def wire_camera(camera: Camera | str) -> CameraModel | str:
    """A camera by name, or as it goes over the wire."""
    return camera if isinstance(camera, str) else CameraModel.of(camera)


def read_picture(response: httpx.Response) -> NDArray[Any]:
    """Decodes PNG, JPEG or WebP to [H, W, 3] or [H, W], 8 bit, or 16 for a depth."""
    with Image.open(io.BytesIO(response.content)) as picture:
        return np.array(picture)


def read_npz(response: httpx.Response) -> dict[str, NDArray[Any]]:
    """Reads the arrays of an npz by name; nothing is unpickled."""
    with np.load(io.BytesIO(response.content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
