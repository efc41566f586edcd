"""Novel views."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from client.wire import RenderFormat, RenderKind, RenderRequest
from server.messages import RenderQuery
from server.problems import Problem
from server.routes.access import TheScene, TheSettings
from server.scenes import Scene
from server.settings import ServerSettings

router = APIRouter(prefix="/v1/scenes", tags=["views"])

PICTURES: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {"image/png": {}, "image/jpeg": {}, "application/vnd.numpy.npz": {}},
        "description": "The view; X-Frame says of which frame.",
    }
}


@router.post("/{id}/render", response_class=Response, responses=PICTURES)
async def render(scene: TheScene, server: TheSettings, request: RenderRequest) -> Response:
    """Any camera at any committed frame, from the last committed state; an update at work is not waited for."""
    return await answer(scene, server, request)


@router.get("/{id}/render", response_class=Response, responses=PICTURES)
async def render_by_name(
    scene: TheScene,
    server: TheSettings,
    camera: Annotated[str | None, Query(max_length=64, description="Of the rig; its first where not given.")] = None,
    frame: Annotated[int | None, Query(ge=0)] = None,
    kind: RenderKind = RenderKind.COLOUR,
    format: RenderFormat = RenderFormat.PNG,
    parts: Annotated[int | None, Query(ge=1, le=254)] = None,
) -> Response:
    """The same for a camera of the rig, as an address to open."""
    name = scene.rig.names[0] if camera is None else camera
    request = RenderRequest(camera=name, frame=frame, kinds=[kind], format=format, parts=parts)
    return await answer(scene, server, request)


async def answer(scene: Scene, server: ServerSettings, request: RenderRequest) -> Response:
    """Checks the request and asks the reader."""
    found = await scene.ask(query_of(scene, server, request))
    return Response(found.body, media_type=found.media_type, headers=found.headers)


def query_of(scene: Scene, server: ServerSettings, request: RenderRequest) -> RenderQuery:
    """The request, checked, as the reader takes it; `server.routes.stream` asks it too."""
    camera = scene.camera(request.camera) if isinstance(request.camera, str) else request.camera.camera()
    pixels = camera.width * camera.height
    if pixels > server.max_render_pixels:
        raise Problem(
            422,
            f"a view of {pixels} pixels",
            field="camera",
            value=f"{camera.width}x{camera.height}",
            remedy=f"ask for at most {server.max_render_pixels} pixels, or raise SCAS4D_MAX_RENDER_PIXELS",
        )
    kinds = tuple(dict.fromkeys(kind.value for kind in request.kinds))
    if request.format != RenderFormat.NPZ and len(kinds) > 1:
        raise Problem(
            422,
            f"{request.format} holds one kind",
            field="kinds",
            value=", ".join(kinds),
            remedy="ask for one kind, or for npz",
        )
    if request.format == RenderFormat.JPEG and kinds[0] in ("depth", "parts"):
        raise Problem(422, f"JPEG would change {kinds[0]}", field="format", value="jpeg", remedy="ask for png or npz")
    background = request.background or scene.spec.settings.scene.background
    return RenderQuery(
        camera, scene.committed_frame(request.frame), kinds, request.format.value, background, request.parts
    )
