"""Routes of the API's reference: Swagger UI as the package `fastapi-offline` has it, with nothing from other sites."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import RedirectResponse, Response

from server.http.files import MEDIA_TYPES, security_headers, serve_file

router = APIRouter(include_in_schema=False)

FOLDER = Path(__file__).parents[1] / "reference"
VENDORED = ("swagger-ui-bundle.js", "swagger-ui.css")
HEADERS = security_headers(style_src="'self' 'unsafe-inline'", img_src="'self' data:")
"""As the viewer's, but Swagger UI sets styles and shows small pictures that its own code has."""


def _files() -> dict[str, Path]:
    """Finds the files that are served by name; the package is not imported, as it needs nothing but its files here."""
    package = find_spec("fastapi_offline")
    assert package is not None, "the package fastapi-offline is not installed; run: pip install 'scas4d[server]'"
    assert package.origin is not None
    vendored = Path(package.origin).parent / "static"
    own = {file.name: file for file in FOLDER.iterdir() if file.suffix in MEDIA_TYPES}
    return own | {name: vendored / name for name in VENDORED}


FILES = _files()


@router.get("/docs")
async def page(request: Request) -> Response:
    """Returns the page."""
    return serve_file(request, FILES, "index.html", HEADERS, "/docs")


@router.get("/redoc")
async def elsewhere() -> Response:
    """Redirects from where FastAPI has a second page of the same."""
    return RedirectResponse("/docs")


@router.get("/docs/{name}")
async def file(request: Request, name: str) -> Response:
    """Returns a file of the page."""
    return serve_file(request, FILES, name, HEADERS, "/docs")
