"""Routes for the viewer: static files without a build step or external resources."""

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
    if file.suffix in MEDIA_TYPES and file.parent.name != "player"  # used by `scas4d export --player` only
}
"""Served files, keyed by name; all other names are refused."""
HEADERS = security_headers(worker_src="'self'")  # prevent script injection through names of rigs or scenes


@router.get("/viewer/")
async def page(request: Request) -> Response:
    """Returns the viewer page."""
    return serve_file(request, FILES, "index.html", HEADERS, "/viewer/")


@router.get("/")
@router.get("/viewer")
async def elsewhere(request: Request) -> Response:
    """Redirects to the viewer page, with a relative URL because a proxy may serve the page under a path prefix."""
    return RedirectResponse(f"viewer/?{request.url.query}" if request.url.query else "viewer/")


@router.get("/viewer/{name:path}")
async def file(request: Request, name: str) -> Response:
    """Returns a file of the viewer."""
    return serve_file(request, FILES, name, HEADERS, "/viewer/")
