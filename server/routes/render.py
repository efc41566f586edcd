"""Routes that render novel views."""

from __future__ import annotations

import math
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from client import __version__
from client.wire import MAX_PIXELS_A_SIDE, RenderFormat, RenderKind, RenderRequest
from server.http.immutable import content_disposition, matches_etag
from server.problems import Problem
from server.queries.render import render_query
from server.routes.access import TheScene, ask

router = APIRouter(prefix="/v1/scenes", tags=["views"])

FILES = ("image/png", "image/jpeg", "image/webp", "application/vnd.numpy.npz", "application/octet-stream")
PICTURES: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {media_type: {"schema": {"type": "string", "format": "binary"}} for media_type in FILES},
        "description": "Rendered view; the X-Frame header contains its frame index.",
    }
}
ENDINGS = {one: f".{'jpg' if one == RenderFormat.JPEG else one.value}" for one in RenderFormat}
"""File extension of each image format."""


@router.post("/{id}/render", response_class=Response, responses=PICTURES)
async def render(scene: TheScene, request: Request, view: RenderRequest) -> Response:
    """Renders a committed frame from any camera without waiting for a running update."""
    response = await ask(request, scene, render_query(scene, view))
    return Response(
        response.body, media_type=response.media_type, headers={**response.headers, "Cache-Control": "no-store"}
    )


@router.get("/{id}/render", response_class=Response, responses=PICTURES)
async def render_by_name(
    scene: TheScene,
    request: Request,
    camera: Annotated[
        str | None, Query(max_length=64, description="Name of a camera of the rig; the first by default.")
    ] = None,
    frame: Annotated[int | None, Query(ge=0, description="Index of a committed frame; the last by default.")] = None,
    kind: RenderKind = RenderKind.COLOUR,
    format: RenderFormat = RenderFormat.PNG,
    width: Annotated[int | None, Query(ge=1, le=MAX_PIXELS_A_SIDE, description="Width of the image in pixels.")] = None,
    quality: Annotated[int | None, Query(ge=1, le=100, description="Quality of JPEG and WebP images.")] = None,
    background: Annotated[
        str | None, Query(max_length=64, description="Background colour as red,green,blue in [0, 1], such as 1,1,1.")
    ] = None,
    parts: Annotated[
        int | None, Query(ge=1, le=254, description="Number of parts; chosen by the scene by default.")
    ] = None,
) -> Response:
    """Renders a committed frame from a camera of the rig; the URL can be used in an `<img>` element."""
    view = RenderRequest(
        camera=scene.rig.names[0] if camera is None else camera,
        frame=frame,
        kinds=[kind],
        format=format,
        width=width,
        quality=quality,
        background=None if background is None else _colour(background),
        parts=parts,
    )
    query = render_query(scene, view)
    # Views of the latest frame and of parts change over time, so they are not cached. A frame given by index stays the
    # same until the reconstruction restarts, except that a damaged state may be recomputed with equivalent quality.
    # Hence the weak ETag, and `no-cache`, which makes browsers revalidate a view before they reuse it.
    keep = {"Cache-Control": "no-store"}
    if view.frame is not None and RenderKind.PARTS not in view.kinds:
        keep = {
            "Cache-Control": "private, no-cache",
            "ETag": f'W/"{__version__}-{scene.ledger.reconstruction}-{view.frame}"',
        }
        if matches_etag(request, keep["ETag"]):
            return Response(status_code=304, headers=keep)
    response = await ask(request, scene, query)
    seen_by = view.camera if isinstance(view.camera, str) else "view"
    name = f"{scene.id[:8]}-{query.frame:06d}-{seen_by}-{query.kinds[0]}{ENDINGS[view.format]}"
    keep["Content-Disposition"] = content_disposition(name, inline=True)
    return Response(response.body, media_type=response.media_type, headers={**response.headers, **keep})


def _colour(text: str) -> tuple[float, float, float]:
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        red = green = blue = math.nan
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise Problem(
            422,
            "background must be three numbers in [0, 1]",
            field="background",
            value=text,
            remedy="use, for example, background=1,1,1",
        )
    return red, green, blue
