"""API request as a value (`Call`), with helpers for paths, request bodies and response parsing."""

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
    """Single request to the service.

    Attributes:
        method: HTTP method.
        path: path relative to the address of the service.
        parse: converts the response to the return value of the call.
        repeatable: whether the request is idempotent, so that a client may retry it.
        arguments: further arguments of `httpx.Client.request`.
    """

    method: str
    path: str
    parse: Callable[[httpx.Response], T]
    repeatable: bool = True
    arguments: dict[str, Any] = field(default_factory=dict)


def path(*parts: str | int) -> str:
    """Returns a path below /v1/scenes; each part is URL-quoted."""
    return "/".join(["/v1/scenes", *(quote(str(part), safe="") for part in parts)])


def json_reader(model: type[M]) -> Callable[[httpx.Response], M]:
    """Returns a function that parses the JSON of a response as a wire model."""
    return lambda response: model.model_validate_json(response.content)


def nothing(response: httpx.Response) -> None:
    """Ignores a response without a body."""


def body(model: BaseModel) -> dict[str, Any]:
    """Returns the request arguments for a wire model as JSON; unset fields are omitted."""
    return {"json": model.model_dump(mode="json", exclude_unset=True)}


def wire_camera(camera: Camera | str) -> CameraModel | str:
    """Returns a camera name unchanged, or the wire model of a camera."""
    return camera if isinstance(camera, str) else CameraModel.of(camera)


def read_picture(response: httpx.Response) -> NDArray[Any]:
    """Returns the decoded PNG, JPEG or WebP as [H, W, 3] or [H, W], with 8 bits, or 16 bits for depth."""
    with Image.open(io.BytesIO(response.content)) as picture:
        return np.array(picture)


def read_npz(response: httpx.Response) -> dict[str, NDArray[Any]]:
    """Returns the arrays of an npz by name; pickled data is refused."""
    with np.load(io.BytesIO(response.content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
