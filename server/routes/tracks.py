"""Routes for point tracks and the lifetimes of Gaussians; docs/tracks.md describes the responses."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response

from client.wire import GaussiansModel, TracksModel, TracksRequest
from server.problems import Problem
from server.processes.queries import GaussiansQuery
from server.queries.tracks import check_ids, tracks_query
from server.routes.access import FirstFrame, LastFrame, TheScene, ask
from server.scene.scene import Scene

router = APIRouter(prefix="/v1/scenes")

Many = Annotated[list[str] | None, Query(max_length=1024)]
ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"model": TracksModel, "content": {"application/vnd.numpy.npz": {}}, "description": "Tracks as JSON or npz."}
}
LIFETIMES: dict[int | str, dict[str, Any]] = {200: {"model": GaussiansModel}}


@router.post("/{id}/tracks/query", response_class=Response, responses=ANSWERS, tags=["tracks"])
async def query(scene: TheScene, http: Request, request: TracksRequest) -> Response:
    """Returns world-space trajectories of Gaussians, given by id, or of pixels or 3D points."""
    return await answer(http, scene, request)


@router.get("/{id}/tracks", response_class=Response, responses=ANSWERS, tags=["tracks"])
async def tracks(
    scene: TheScene,
    http: Request,
    ids: Annotated[str | None, Query(max_length=10_000, description="Ids of Gaussians, separated by commas.")] = None,
    pixel: Annotated[Many, Query(description="u,v in the image of `camera`; may be repeated.")] = None,
    camera: Annotated[
        str | None, Query(max_length=64, description="Name of the rig camera whose pixels are given.")
    ] = None,
    point: Annotated[Many, Query(description="x,y,z in the rig's world and units; may be repeated.")] = None,
    at: Annotated[
        int | None, Query(ge=0, description="Frame of the pixels or points; the first committed frame by default.")
    ] = None,
    first: FirstFrame = None,
    last: LastFrame = None,
    project: Annotated[Many, Query(max_length=64, description="Cameras to project the tracks into.")] = None,
    format: Literal["json", "npz"] = "json",
) -> Response:
    """Returns trajectories like `POST …/tracks/query`, for a few points given in the query string."""
    request = TracksRequest(
        ids=ids_in(ids) if ids else None,
        pixels=_numbers(pixel, "pixel", 2) if pixel else None,
        camera=camera,
        points=_numbers(point, "point", 3) if point else None,
        at=at,
        first=first,
        last=last,
        project=list(project or []),
        format=format,
    )
    return await answer(http, scene, request)


@router.get("/{id}/gaussians", response_class=Response, responses=LIFETIMES, tags=["gaussians"])
async def gaussians(
    scene: TheScene,
    request: Request,
    ids: Annotated[str, Query(min_length=1, max_length=10_000, description="Ids of Gaussians, separated by commas.")],
) -> Response:
    """Returns the frames in which Gaussians were created, retired and revived; ids are never reused."""
    scene.committed_frame(None, "id")
    wanted = ids_in(ids)
    check_ids(wanted)
    lifetimes = await ask(request, scene, GaussiansQuery(tuple(wanted)))
    return Response(lifetimes.body, media_type=lifetimes.media_type)


async def answer(http: Request, scene: Scene, request: TracksRequest) -> Response:
    """Returns the readers' answer to a validated track request."""
    response = await ask(http, scene, tracks_query(scene, request))
    return Response(response.body, media_type=response.media_type)


def ids_in(text: str) -> list[int]:
    """Parses the ids in a comma-separated query parameter."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise Problem(
            422,
            "ids must be integers",
            field="ids",
            value=text,
            remedy="separate ids by commas, such as ids=3,17,2048",
        ) from None


def _numbers(texts: list[str], field: str, count: int) -> list[list[float]]:
    rows = []
    for text in texts:
        try:
            row = [float(part) for part in text.split(",")]
        except ValueError:
            row = []
        if len(row) != count or not all(math.isfinite(value) for value in row):
            example = ",".join("12.5" for _ in range(count))
            raise Problem(
                422,
                f"{field} must be {count} finite numbers",
                field=field,
                value=text,
                remedy=f"use, for example, {field}={example}",
            )
        rows.append(row)
    return rows
