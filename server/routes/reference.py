"""Routes of the API's reference: Swagger UI as the package `fastapi-offline` has it, with nothing from other sites."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from fastapi import APIRouter
from starlette.responses import FileResponse, RedirectResponse, Response

from server.problems import Problem

router = APIRouter(include_in_schema=False)

FOLDER = Path(__file__).parents[1] / "reference"
MEDIA_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
VENDORED = ("swagger-ui-bundle.js", "swagger-ui.css")
HEADERS = {
    # As the viewer's, but Swagger UI sets styles and shows small pictures that its own code has.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}


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
async def page() -> Response:
    """Returns the page."""
    return _answer("index.html")


@router.get("/redoc")
async def elsewhere() -> Response:
    """Redirects from where FastAPI has a second page of the same."""
    return RedirectResponse("/docs")


@router.get("/docs/{name}")
async def file(name: str) -> Response:
    """Returns a file of the page."""
    return _answer(name)


def _answer(name: str) -> Response:
    found = FILES.get(name)
    if found is None:
        raise Problem(404, f"the reference has no file {name!r}", field="name", value=name, remedy="open /docs")
    return FileResponse(found, media_type=MEDIA_TYPES[found.suffix], headers=HEADERS)
