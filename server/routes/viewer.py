"""Routes of the viewer's page: its files as they are, without a build step, and nothing from other sites."""

from __future__ import annotations

from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import RedirectResponse, Response

from server.http.files import MEDIA_TYPES, security_headers, serve_file

router = APIRouter(include_in_schema=False)

FOLDER = Path(__file__).parents[1] / "viewer"
FILES = {
    str(file.relative_to(FOLDER)): file
    for file in FOLDER.rglob("*")
    if file.suffix in MEDIA_TYPES and file.parent.name != "player"  # of the page that `scas4d export --player` writes
}
"""The files that are served: these names and no others."""
HEADERS = security_headers(worker_src="'self'")  # what a rig or a scene is called stays text


@router.get("/")
@router.get("/viewer/")
async def page(request: Request) -> Response:
    """Returns the page."""
    return serve_file(request, FILES, "index.html", HEADERS, "/viewer/")


@router.get("/viewer")
async def elsewhere() -> Response:
    """Redirects to the page from the address without a slash."""
    return RedirectResponse("/viewer/")


@router.get("/viewer/{name:path}")
async def file(request: Request, name: str) -> Response:
    """Returns a file of the page."""
    return serve_file(request, FILES, name, HEADERS, "/viewer/")
