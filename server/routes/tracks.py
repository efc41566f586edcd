"""Point tracks."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Query, Response
from numpy.typing import NDArray

from client.wire import TracksModel
from server.messages import TracksQuery
from server.problems import Problem
from server.routes.access import TheScene, TheSettings
from server.scenes import Scene

router = APIRouter(prefix="/v1/scenes", tags=["tracks"])

Many = Annotated[list[str] | None, Query(max_length=4096)]
ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"model": TracksModel, "content": {"application/vnd.numpy.npz": {}}, "description": "As JSON or npz."}
}


@router.get("/{id}/tracks", response_class=Response, responses=ANSWERS)
async def tracks(
    scene: TheScene,
    server: TheSettings,
    ids: Annotated[str | None, Query(max_length=100_000, description="Of Gaussians, separated by commas.")] = None,
    pixel: Annotated[Many, Query(description="u,v in the picture of `camera`, repeated.")] = None,
    camera: Annotated[str | None, Query(max_length=64, description="Of the rig: where the pixels are.")] = None,
    point: Annotated[Many, Query(description="x,y,z in the rig's world and units, repeated.")] = None,
    at: Annotated[int | None, Query(ge=0, description="Frame of the pixels or points; the first committed.")] = None,
    first: Annotated[int | None, Query(alias="from", ge=0, description="First frame; the first committed.")] = None,
    last: Annotated[
        int | None, Query(alias="to", ge=0, description="Last frame, included; the last committed.")
    ] = None,
    project: Annotated[Many, Query(description="Cameras of the rig to project into, with visibility.")] = None,
    format: Literal["json", "npz"] = "json",
) -> Response:
    """Trajectories in the world of what is asked for by id, by pixel, or by 3D point."""
    asked = [name for name, value in (("ids", ids), ("pixel", pixel), ("point", point)) if value]
    if len(asked) != 1:
        raise Problem(
            422, "ask by one of ids, pixel, point", field="ids", value=", ".join(asked), remedy="give exactly one"
        )
    start = scene.committed_frame(None, "from") and scene.committed[0] if first is None else first
    end = scene.committed[-1] if last is None else last
    frames = tuple(index for index in scene.committed if start <= index <= end)
    if not frames:
        raise Problem(
            422,
            f"no committed frame from {start} to {end}",
            field="from",
            value=start,
            remedy=f"ask within {scene.committed[0]} to {scene.committed[-1]}",
        )
    query = TracksQuery(
        frames=frames,
        at=scene.committed_frame(scene.committed[0] if at is None else at, "at"),
        ids=_ids(ids) if ids else None,
        camera=_camera(scene, camera) if pixel else None,
        pixels=_numbers(pixel, "pixel", 2) if pixel else None,
        points=_numbers(point, "point", 3) if point else None,
        project=tuple(scene.camera(name) for name in dict.fromkeys(project or [])),
        format=format,
    )
    queries = next(len(value) for value in (query.ids, query.pixels, query.points) if value is not None)
    if queries * len(frames) > server.max_track_points:
        raise Problem(
            422,
            f"{queries} points over {len(frames)} frames",
            field=asked[0],
            value=queries * len(frames),
            remedy=f"ask for at most {server.max_track_points} at once, or raise SCAS4D_MAX_TRACK_POINTS",
        )
    answer = await scene.ask(query)
    return Response(answer.body, media_type=answer.media_type)


def _camera(scene: Scene, name: str | None) -> Any:
    if name is None:
        raise Problem(422, "pixels of which camera?", field="camera", remedy=f"one of {', '.join(scene.rig.names)}")
    return scene.camera(name)


def _ids(text: str) -> tuple[int, ...]:
    try:
        ids = tuple(int(part) for part in text.split(","))
        np.array(ids, dtype=np.int64)
    except (ValueError, OverflowError):
        raise Problem(422, "ids are whole numbers", field="ids", value=text, remedy="give 3,17,2048") from None
    return ids


def _numbers(texts: list[str], field: str, count: int) -> NDArray[np.float64]:
    rows = []
    for text in texts:
        try:
            row = [float(part) for part in text.split(",")]
        except ValueError:
            row = []
        if len(row) != count or not all(math.isfinite(value) for value in row):
            example = ",".join("12.5" for _ in range(count))
            raise Problem(
                422, f"{field} is {count} finite numbers", field=field, value=text, remedy=f"give {field}={example}"
            )
        rows.append(row)
    return np.array(rows)
