"""Conversion of view requests from HTTP and live subscriptions into render queries."""

from __future__ import annotations

from client.wire import RenderFormat, RenderRequest
from server.problems import Problem, count_noun
from server.processes.queries import RenderQuery
from server.scene.scene import Scene

MOST_PIXELS = 8_000_000
"""Maximum number of pixels per view, about 4K, which takes a few seconds on one core.

Larger views would delay other queries for too long.
"""

SEVERAL = (RenderFormat.NPZ, RenderFormat.FLOAT32)
LOSSY = (RenderFormat.JPEG, RenderFormat.WEBP)


def render_query(scene: Scene, request: RenderRequest) -> RenderQuery:
    """Returns the reader query for a view request after validating it.

    Raises:
        Problem: 404, 409 or 503 if the frame cannot be read; 422 if the request is invalid.
    """
    camera = scene.camera(request.camera) if isinstance(request.camera, str) else request.camera.camera()
    if request.width is not None:
        camera = camera.scaled(request.width / camera.width)
    pixels = camera.width * camera.height
    if pixels > MOST_PIXELS:
        raise Problem(
            422,
            f"the view has {pixels} pixels, more than {MOST_PIXELS}",
            field="camera" if request.width is None else "width",
            value=f"{camera.width}x{camera.height}",
            remedy=f"request at most {MOST_PIXELS} pixels",
        )
    kinds = tuple(dict.fromkeys(kind.value for kind in request.kinds))
    if request.format not in SEVERAL and len(kinds) > 1:
        raise Problem(
            422,
            f"{request.format} can store only one kind, got {count_noun(len(kinds), 'kind')}",
            field="kinds",
            value=", ".join(kinds),
            remedy="request one kind, or use format npz or float32",
        )
    if request.format in LOSSY and kinds[0] in ("depth", "parts"):
        raise Problem(
            422,
            f"{request.format} would distort {kinds[0]}",
            field="format",
            value=request.format.value,
            remedy="use format png, npz or float32",
        )
    own = scene.spec.settings.scene.background
    return RenderQuery(
        camera,
        scene.committed_frame(request.frame),
        kinds,
        request.format.value,
        request.background or (None if own == "auto" else own),
        parts=request.parts,
        quality=request.quality,
    )
