"""Description of an API request (`Call`), with helpers for paths, request bodies and response parsing."""

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
    """Description of a single request to the service.

    Attributes:
        method: HTTP method.
        path: URL path, relative to the service address.
        parse: converts the response to the return value of the call.
        repeatable: whether the request is idempotent, so that a client may retry it.
        arguments: additional arguments for `httpx.Client.request`.
    """

    method: str
    path: str
    parse: Callable[[httpx.Response], T]
    repeatable: bool = True
    arguments: dict[str, Any] = field(default_factory=dict)


def path(*parts: str | int) -> str:
    """Returns the URL path of a resource under /v1/scenes; each part is percent-encoded."""
    return "/".join(["/v1/scenes", *(quote(str(part), safe="") for part in parts)])


def json_reader(model: type[M]) -> Callable[[httpx.Response], M]:
    """Returns a function that parses a JSON response as a wire model."""
    return lambda response: model.model_validate_json(response.content)


def nothing(response: httpx.Response) -> None:
    """Parses a response that has no body; returns None."""


def body(model: BaseModel) -> dict[str, Any]:
    """Returns the request arguments that send a wire model as JSON; unset fields are omitted."""
    return {"json": model.model_dump(mode="json", exclude_unset=True)}


def wire_camera(camera: Camera | str) -> CameraModel | str:
    """Returns the wire model of a camera; camera names are returned unchanged."""
    return camera if isinstance(camera, str) else CameraModel.of(camera)


def read_picture(response: httpx.Response) -> NDArray[Any]:
    """Decodes a PNG, JPEG or WebP response to an array [H, W, 3] or [H, W]: uint8, or 16-bit for depth."""
    with Image.open(io.BytesIO(response.content)) as picture:
        return np.array(picture)


def read_npz(response: httpx.Response) -> dict[str, NDArray[Any]]:
    """Returns the arrays in an npz response, keyed by name; rejects pickled data."""
    with np.load(io.BytesIO(response.content), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
