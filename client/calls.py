"""The requests of the service as values: the sync and the async client send the same ones."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import httpx
import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from client.wire import (
    CameraModel,
    FrameReceipt,
    FrameReportModel,
    Health,
    PartsModel,
    PointsReceipt,
    RenderRequest,
    RigModel,
    SceneCreate,
    SceneList,
    SceneStatus,
    TracksModel,
    TracksRequest,
)
from scas4d_core.cameras import Camera, Rig
from scas4d_core.captures import InitialPoints

T = TypeVar("T")


@dataclass(frozen=True)
class Call(Generic[T]):
    """One request.

    Attributes:
        repeatable: sending it twice does what sending it once does, so a client may try again.
        parse: the answer's body to what the caller gets.
    """

    method: str
    path: str
    parse: Callable[[httpx.Response], T]
    repeatable: bool = True
    arguments: dict[str, Any] = field(default_factory=dict)


def ready() -> Call[Health]:
    """Is the service up?"""
    return Call("GET", "/health/ready", lambda r: Health.model_validate_json(r.content))


def create_scene(
    rig: Rig, *, name: str, preset: str, settings: Mapping[str, Any], frames_per_second: float
) -> Call[SceneStatus]:
    """A new scene. Not repeatable: twice would make two."""
    request = SceneCreate(
        rig=RigModel.of(rig), name=name, preset=preset, settings=dict(settings), frames_per_second=frames_per_second
    )
    arguments = {"json": request.model_dump(mode="json")}
    return Call("POST", "/v1/scenes", lambda r: SceneStatus.model_validate_json(r.content), False, arguments)


def scenes() -> Call[list[SceneStatus]]:
    """All scenes."""
    return Call("GET", "/v1/scenes", lambda r: SceneList.model_validate_json(r.content).scenes)


def scene(id: str) -> Call[SceneStatus]:
    """A scene's status."""
    return Call("GET", f"/v1/scenes/{id}", lambda r: SceneStatus.model_validate_json(r.content))


def delete_scene(id: str) -> Call[None]:
    """Ends a scene."""
    return Call("DELETE", f"/v1/scenes/{id}", lambda r: None)


def put_points(id: str, points: InitialPoints) -> Call[PointsReceipt]:
    """The cloud that frame 0 starts from."""
    arrays: dict[str, NDArray[Any]] = {"positions": points.positions, "colours": points.colours}
    if points.foreground is not None:
        arrays["foreground"] = points.foreground
    body = io.BytesIO()
    np.savez_compressed(body, allow_pickle=False, **arrays)
    arguments = {"content": body.getvalue(), "headers": {"Content-Type": "application/vnd.numpy.npz"}}
    parse = PointsReceipt.model_validate_json
    return Call("PUT", f"/v1/scenes/{id}/points", lambda r: parse(r.content), arguments=arguments)


def put_frame(
    id: str, index: int, images: Mapping[str, bytes], masks: Mapping[str, bytes] | None, time: float | None
) -> Call[FrameReceipt]:
    """One frame: the encoded files by camera name."""
    files = {camera: (camera, data) for camera, data in images.items()}
    files |= {f"mask.{camera}": (f"mask.{camera}", data) for camera, data in (masks or {}).items()}
    arguments: dict[str, Any] = {"files": files}
    if time is not None:
        arguments["data"] = {"time": repr(float(time))}
    parse = FrameReceipt.model_validate_json
    return Call("PUT", f"/v1/scenes/{id}/frames/{index}", lambda r: parse(r.content), arguments=arguments)


def frame(id: str, index: int) -> Call[FrameReportModel]:
    """What became of a frame."""
    parse = FrameReportModel.model_validate_json
    return Call("GET", f"/v1/scenes/{id}/frames/{index}", lambda r: parse(r.content))


def render(id: str, camera: Camera | str, request: Mapping[str, Any], parse: Callable[[bytes], T]) -> Call[T]:
    """A view; `request` holds further fields of `RenderRequest`."""
    model = RenderRequest(camera=_wire(camera), **request)
    arguments = {"json": model.model_dump(mode="json")}
    return Call("POST", f"/v1/scenes/{id}/render", lambda r: parse(r.content), arguments=arguments)


def tracks(
    id: str,
    *,
    ids: Sequence[int] | None,
    pixels: ArrayLike | None,
    camera: Camera | str | None,
    points: ArrayLike | None,
    at: int | None,
    frames: tuple[int, int] | None,
    project: Sequence[Camera | str],
) -> Call[TracksModel]:
    """Trajectories."""
    first, last = frames or (None, None)
    request = TracksRequest(
        ids=None if ids is None else [int(value) for value in ids],
        pixels=None if pixels is None else np.asarray(pixels, dtype=np.float64).tolist(),
        camera=None if camera is None else _wire(camera),
        points=None if points is None else np.asarray(points, dtype=np.float64).tolist(),
        at=at,
        first=first,
        last=last,
        project=[_wire(one) for one in project],
    )
    arguments = {"json": request.model_dump(mode="json")}
    parse = TracksModel.model_validate_json
    return Call("POST", f"/v1/scenes/{id}/tracks/query", lambda r: parse(r.content), arguments=arguments)


def _wire(camera: Camera | str) -> CameraModel | str:
    return camera if isinstance(camera, str) else CameraModel.of(camera)


def parts(id: str, count: int | None) -> Call[PartsModel]:
    """Part labels."""
    arguments = {"params": {} if count is None else {"count": count}}
    return Call(
        "GET", f"/v1/scenes/{id}/parts", lambda r: PartsModel.model_validate_json(r.content), arguments=arguments
    )


def ply(id: str, index: int) -> Call[bytes]:
    """A 3DGS .ply."""
    return Call("GET", f"/v1/scenes/{id}/frames/{index}/splat.ply", lambda r: r.content)


def read_picture(body: bytes) -> NDArray[np.uint8]:
    """PNG or JPEG bytes to [H, W, 3] or [H, W]."""
    with Image.open(io.BytesIO(body)) as picture:
        return np.array(picture)


def read_npz(body: bytes) -> dict[str, NDArray[Any]]:
    """Arrays by name; nothing is unpickled."""
    with np.load(io.BytesIO(body), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
