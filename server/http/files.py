"""Static files of the service's web pages, served with a content security policy and an entity tag."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, Response

from server.http.immutable import matches_etag
from server.problems import Problem

MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".xml": "application/xml",
    ".png": "image/png",
    ".webp": "image/webp",
}


def security_headers(**changes: str) -> dict[str, str]:
    """Returns the security headers of a page's files.

    The default policy forbids content from other sites, inline scripts and styles, and framing.

    Args:
        changes: policy directives to override, with underscores instead of hyphens in their names.
    """
    directives = {"default_src": "'none'"}
    directives |= dict.fromkeys(("script_src", "style_src", "img_src", "connect_src"), "'self'")
    directives |= dict.fromkeys(("base_uri", "form_action", "frame_ancestors"), "'none'") | changes
    return {
        "Content-Security-Policy": "; ".join(f"{name.replace('_', '-')} {value}" for name, value in directives.items()),
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-cache",  # revalidated by ETag, so that updates appear immediately
    }


def serve_file(
    request: Request, files: Mapping[str, Path], name: str, headers: Mapping[str, str], page: str
) -> Response:
    """Returns a response with a static file, or 304 if the client already has it.

    Args:
        request: HTTP request.
        files: paths of the available files, keyed by name.
        name: name of the requested file.
        headers: response headers.
        page: URL path of the page that uses the files, quoted in the remedy.

    Raises:
        Problem: 404 if there is no file of that name.
    """
    file = files.get(name)
    if file is None:
        raise Problem(404, f"no such file: {name!r}", field="name", value=name, remedy=f"open {page}")
    answer = FileResponse(file, media_type=MEDIA_TYPES[file.suffix], headers=dict(headers), stat_result=file.stat())
    if matches_etag(request, tag := answer.headers["etag"]):
        return Response(status_code=304, headers={**headers, "ETag": tag})
    return answer
