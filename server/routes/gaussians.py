"""Route for the lifetimes of Gaussians."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from client.wire import GaussiansModel
from server.processes.queries import GaussiansQuery
from server.queries.tracks import check_ids
from server.routes.access import TheScene, ask
from server.routes.tracks import ids_in

router = APIRouter(prefix="/v1/scenes", tags=["gaussians"])

ANSWERS: dict[int | str, dict[str, Any]] = {200: {"model": GaussiansModel}}


@router.get("/{id}/gaussians", response_class=Response, responses=ANSWERS)
async def gaussians(
    scene: TheScene,
    request: Request,
    ids: Annotated[str, Query(min_length=1, max_length=10_000, description="Ids of Gaussians, separated by commas.")],
) -> Response:
    """Returns the frames in which Gaussians were created, retired and revived; ids are never reused."""
    scene.committed_frame(None, "id")
    wanted = ids_in(ids)
    check_ids(wanted)
    answer = await ask(request, scene, GaussiansQuery(tuple(wanted)))
    return Response(answer.body, media_type=answer.media_type)
