"""Routes of the viewer's page: its files as they are, without a build step, and nothing from other sites."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter
from starlette.responses import FileResponse, RedirectResponse, Response

from server.problems import Problem

router = APIRouter(include_in_schema=False)

FOLDER = Path(__file__).parents[1] / "viewer"
MEDIA_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
FILES = {str(file.relative_to(FOLDER)): file for file in FOLDER.rglob("*") if file.suffix in MEDIA_TYPES}
"""The files that are served: these names and no others."""

HEADERS = {
    # No inline script or style, nothing from another site, no frames: what a rig or a scene is called stays text.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",  # asked for again each time, by its tag: an update of the service shows at once
}


@router.get("/")
@router.get("/viewer/")
async def page() -> Response:
    """Returns the page."""
    return _answer("index.html")


@router.get("/viewer")
async def elsewhere() -> Response:
    """Redirects to the page from the address without a slash."""
    return RedirectResponse("/viewer/")


@router.get("/viewer/{name:path}")
async def file(name: str) -> Response:
    """Returns a file of the page."""
    return _answer(name)


def _answer(name: str) -> Response:
    found = FILES.get(name)
    if found is None:
        raise Problem(404, f"the viewer has no file {name!r}", field="name", value=name, remedy="open /viewer/")
    return FileResponse(found, media_type=MEDIA_TYPES[found.suffix], headers=HEADERS)
