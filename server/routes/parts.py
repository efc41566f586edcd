"""Route for parts, which are groups of Gaussians that move together."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from client.wire import PartsModel
from server.processes.queries import PartsQuery
from server.routes.access import TheScene, ask

router = APIRouter(prefix="/v1/scenes", tags=["parts"])

ANSWERS: dict[int | str, dict[str, Any]] = {200: {"model": PartsModel}}


@router.get("/{id}/parts", response_class=Response, responses=ANSWERS)
async def parts(
    scene: TheScene,
    request: Request,
    count: Annotated[
        int | None, Query(ge=1, le=254, description="Number of parts; by default chosen automatically.")
    ] = None,
) -> Response:
    """Returns a part label for every Gaussian, computed from its motion over all committed frames."""
    scene.committed_frame(None, "id")
    answer = await ask(request, scene, PartsQuery(count))
    return Response(answer.body, media_type=answer.media_type)
