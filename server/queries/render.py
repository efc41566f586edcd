"""Makes the query of a view, for requests over HTTP and for live views."""

from __future__ import annotations

from client.wire import RenderFormat, RenderRequest
from server.problems import Problem, count_noun
from server.processes.queries import RenderQuery
from server.scene.scene import Scene

MOST_PIXELS = 8_000_000
"""Pixels of one view: 4K, some seconds on one core. A larger one would keep others waiting."""

SEVERAL = (RenderFormat.NPZ, RenderFormat.FLOAT32)
LOSSY = (RenderFormat.JPEG, RenderFormat.WEBP)


def render_query(scene: Scene, request: RenderRequest) -> RenderQuery:
    """Checks a request for a view and returns the query to the reader.

    Raises:
        Problem: 404, 409 or 503, the frame cannot be read; 422, the request cannot be met.
    """
    camera = scene.camera(request.camera) if isinstance(request.camera, str) else request.camera.camera()
    if request.width is not None:
        camera = camera.scaled(request.width / camera.width)
    pixels = camera.width * camera.height
    if pixels > MOST_PIXELS:
        raise Problem(
            422,
            f"a view of {pixels} pixels",
            field="camera" if request.width is None else "width",
            value=f"{camera.width}x{camera.height}",
            remedy=f"ask for at most {MOST_PIXELS} pixels",
        )
    kinds = tuple(dict.fromkeys(kind.value for kind in request.kinds))
    if request.format not in SEVERAL and len(kinds) > 1:
        raise Problem(
            422,
            f"{request.format} cannot contain {count_noun(len(kinds), 'kind')}",
            field="kinds",
            value=", ".join(kinds),
            remedy="ask for one kind, or for npz or float32",
        )
    if request.format in LOSSY and kinds[0] in ("depth", "parts"):
        raise Problem(
            422,
            f"{request.format} would change {kinds[0]}",
            field="format",
            value=request.format.value,
            remedy="ask for png, npz or float32",
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
