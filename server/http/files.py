"""Files of the pages that the service has: each under a policy, with a tag, and none but those."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, Response

from server.http.unchanging import is_known
from server.problems import Problem

MEDIA_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}


def policy(**changes: str) -> dict[str, str]:
    """Returns the headers of a page's files: nothing from other sites, no inline script or style, no frames.

    Args:
        changes: of directives of the policy, with underscores in place of hyphens.
    """
    directives = {"default_src": "'none'"}
    directives |= dict.fromkeys(("script_src", "style_src", "img_src", "connect_src"), "'self'")
    directives |= dict.fromkeys(("base_uri", "form_action", "frame_ancestors"), "'none'") | changes
    return {
        "Content-Security-Policy": "; ".join(f"{name.replace('_', '-')} {value}" for name, value in directives.items()),
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-cache",  # asked for again each time, by its tag: an update of the service shows at once
    }


def served(request: Request, files: Mapping[str, Path], name: str, headers: Mapping[str, str], page: str) -> Response:
    """Answers with one of the files, 304 where the asker has it already.

    Args:
        files: those that there are, by name. name: of the file. page: where they are shown, for the remedy.

    Raises:
        Problem: 404, it is not one of them.
    """
    file = files.get(name)
    if file is None:
        raise Problem(404, f"the page has no file {name!r}", field="name", value=name, remedy=f"open {page}")
    answer = FileResponse(file, media_type=MEDIA_TYPES[file.suffix], headers=dict(headers), stat_result=file.stat())
    if is_known(request, tag := answer.headers["etag"]):
        return Response(status_code=304, headers={**headers, "ETag": tag})
    return answer
