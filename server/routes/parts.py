"""Routes for parts, which are groups of Gaussians that move together, and for the joints between them."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from client.wire import JointsModel, PartsModel
from server.problems import Problem, count_noun
from server.processes.queries import JointsQuery, PartsQuery
from server.routes.access import FirstFrame, LastFrame, TheScene, ask

router = APIRouter(prefix="/v1/scenes", tags=["parts"])

MOST_JOINT_FRAMES = 240
"""Maximum number of frames of a query for joints, whose poses take up to ten seconds of reader time."""
ANSWERS: dict[int | str, dict[str, Any]] = {200: {"model": PartsModel}}
JOINT_ANSWERS: dict[int | str, dict[str, Any]] = {200: {"model": JointsModel}}


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


@router.get("/{id}/joints", response_class=Response, responses=JOINT_ANSWERS)
async def joints(
    scene: TheScene,
    request: Request,
    count: Annotated[
        int | None, Query(ge=1, le=32, description="Number of parts; by default chosen automatically.")
    ] = None,
    first: FirstFrame = None,
    last: LastFrame = None,
) -> Response:
    """Returns the joints between parts, found from their motion over all frames, with their values in some frames."""
    frames = scene.committed_range(first, last, "from")
    if len(frames) > MOST_JOINT_FRAMES:
        raise Problem(
            422,
            f"joints were requested in {count_noun(len(frames), 'frame')}; at most {MOST_JOINT_FRAMES} are allowed",
            field="to",
            value=frames[-1],
            remedy=f"use a smaller range, such as from={frames[0]} and to={frames[MOST_JOINT_FRAMES - 1]}",
        )
    answer = await ask(request, scene, JointsQuery(frames, count))
    return Response(answer.body, media_type=answer.media_type)
