"""Routes for the pages of docs/ as a site, and for the API reference, without external resources.

`scripts/build_site.py` builds the site. The API reference is Swagger UI from the package `fastapi-offline`.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Iterable
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

from fastapi import APIRouter, Request
from starlette.responses import RedirectResponse, Response

from server.http.files import MEDIA_TYPES, security_headers, serve_file

router = APIRouter(include_in_schema=False)

FOLDER = Path(__file__).parents[1] / "reference"
SITE = Path(__file__).parents[1] / "site"
"""Folder of the site; it is missing until the site is built."""
VENDORED = ("swagger-ui-bundle.js", "swagger-ui.css")
REFERENCE = "reference.html"
INLINE_SCRIPT = re.compile(rb"<script>(.*?)</script>", re.DOTALL)


def _files() -> dict[str, Path]:
    """Returns the served files, keyed by name; the package is not imported, because only its files are needed."""
    package = find_spec("fastapi_offline")
    assert package is not None, "the package fastapi-offline is not installed; run: pip install 'scas4d[server]'"
    assert package.origin is not None
    vendored = Path(package.origin).parent / "static"
    own = {file.name: file for file in FOLDER.iterdir() if file.suffix in MEDIA_TYPES}
    site = {file.relative_to(SITE).as_posix(): file for file in SITE.rglob("*") if file.suffix in MEDIA_TYPES}
    return site | own | {name: vendored / name for name in VENDORED}


def _script_hashes(pages: Iterable[Path]) -> str:
    """Returns the sources of a content security policy that allow only the inline scripts of the given pages."""
    scripts = {script for page in pages for script in INLINE_SCRIPT.findall(page.read_bytes())}
    return " ".join(sorted(f"'sha256-{b64encode(sha256(script).digest()).decode()}'" for script in scripts))


FILES = _files()
HEADERS = security_headers(
    script_src=f"'self' {_script_hashes(file for file in FILES.values() if file.suffix == '.html')}".strip(),
    style_src="'self' 'unsafe-inline'",
    img_src="'self' data:",
    worker_src="'self'",
)
"""Security headers like those of the viewer. The site has inline scripts, and its search runs in a worker; Swagger UI
also needs inline styles and `data:` images."""


@router.get("/docs")
async def redirect_to_site() -> Response:
    """Redirects to the site, with a relative URL because a proxy may serve the page under a path prefix."""
    return RedirectResponse("docs/")


@router.get("/redoc")
async def redirect_to_reference() -> Response:
    """Redirects FastAPI's usual ReDoc address to the API reference."""
    return RedirectResponse(f"docs/{REFERENCE}")


@router.get("/docs/")
async def site_index(request: Request) -> Response:
    """Returns the first page of the site, or redirects to the API reference if the site was not built."""
    if "index.html" not in FILES:
        return RedirectResponse(REFERENCE)
    return serve_file(request, FILES, "index.html", HEADERS, "/docs/")


@router.get("/docs/{name:path}")
async def file(request: Request, name: str) -> Response:
    """Returns a file of the site or of the API reference."""
    return serve_file(request, FILES, name, HEADERS, "/docs/")
