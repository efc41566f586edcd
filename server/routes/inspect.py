"""Routes for the rig and for frame reports, used by viewers."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from client.wire import RigModel
from client.wire.frames import FrameList
from server.routes.access import TheRecord, TheScene

router = APIRouter(prefix="/v1/scenes")

MOST_FRAMES = 500
"""Maximum number of frames per response; each report lists every camera."""


@router.get("/{id}/rig", tags=["scenes"])
async def rig(scene: TheRecord) -> RigModel:
    """Returns the camera rig of the scene as uploaded, without calibration corrections."""
    return scene.request.rig


@router.get("/{id}/frames", tags=["frames"])
async def frames(
    scene: TheScene,
    first: Annotated[int, Query(ge=0, le=1_000_000_000, description="Index of the first frame.")] = 0,
    limit: Annotated[int, Query(ge=1, le=MOST_FRAMES, description="Maximum number of frames.")] = MOST_FRAMES,
) -> FrameList:
    """Returns the reports of up to `limit` frames starting at `first`; `next` is the `first` of the next page."""
    after = min(first + limit, scene.next_frame)  # frame indices have no gaps
    reports = [await scene.report(index) for index in range(first, after)]
    short = [report.model_copy(update={"loss": [], "curve": []}) for report in reports if report is not None]
    return FrameList(frames=short, next=after if first <= after < scene.next_frame else None)
