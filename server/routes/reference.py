"""Routes for the API reference: Swagger UI from the package `fastapi-offline`, without external resources."""

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
"""Security headers like those of the viewer, but Swagger UI also needs inline styles and `data:` images."""


def _files() -> dict[str, Path]:
    """Returns the served files, keyed by name; the package is not imported, because only its files are needed."""
    package = find_spec("fastapi_offline")
    assert package is not None, "the package fastapi-offline is not installed; run: pip install 'scas4d[server]'"
    assert package.origin is not None
    vendored = Path(package.origin).parent / "static"
    own = {file.name: file for file in FOLDER.iterdir() if file.suffix in MEDIA_TYPES}
    return own | {name: vendored / name for name in VENDORED}


FILES = _files()


@router.get("/docs")
async def page(request: Request) -> Response:
    """Returns the API reference page."""
    return serve_file(request, FILES, "index.html", HEADERS, "/docs")


@router.get("/redoc")
async def elsewhere() -> Response:
    """Redirects FastAPI's usual ReDoc address to the API reference page."""
    return RedirectResponse("docs")


@router.get("/docs/{name}")
async def file(request: Request, name: str) -> Response:
    """Returns a file of the API reference page."""
    return serve_file(request, FILES, name, HEADERS, "/docs")
