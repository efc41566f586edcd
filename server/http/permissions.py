"""Permissions granted by tokens. A read-only permission does not allow changes or new frames."""

from __future__ import annotations

import re
from typing import NamedTuple

from starlette.types import Scope

from server.problems import Problem

READS = re.compile(r"/v1/(tickets|estimate|scenes/[^/]+/(render|tracks/query))")
"""Pattern of paths where POST is a read operation with the query in the body."""
READ_SOCKETS = re.compile(r"/v1/scenes/[^/]+/stream")
"""Pattern of the WebSocket paths that only send data to the client."""


class Permission(NamedTuple):
    """Permission granted by a token.

    Attributes:
        write: whether writing is allowed; reading always is.
        scene: id of the only accessible scene; None for all scenes.
        end: expiry time in seconds since the epoch; None if the permission does not expire.
    """

    write: bool = False
    scene: str | None = None
    end: int | None = None


ALL = Permission(write=True)
PERMISSION = "scas4d.permission"
"""Key of the permission in the ASGI scope of a request."""


def check(permission: Permission, scope: Scope) -> None:
    """Checks that the permission allows the request.

    Raises:
        Problem: 403 for a write with a read-only permission; 404 for a path outside the permitted scene, so that the
            response does not reveal whether another scene exists.
    """
    path, reading = scope["path"], _reads(scope)
    if permission.scene is not None:
        own = f"/v1/scenes/{permission.scene}"
        if path != own and not path.startswith((own + "/", "/v1/tickets")) and path != "/v1/scenes":
            raise Problem(
                404,
                "this link gives access to one scene only",
                field="path",
                value=path,
                remedy=f"request {own}, or send the service's token",
            )
    if not (permission.write or reading):
        raise Problem(
            403,
            "this token is read-only",
            field="Authorization",
            remedy="send the service's token (SCAS4D_TOKEN)",
        )


def _reads(scope: Scope) -> bool:
    if scope["type"] == "websocket":
        return READ_SOCKETS.fullmatch(scope["path"]) is not None
    return scope["method"] in ("GET", "HEAD", "OPTIONS") or (
        scope["method"] == "POST" and READS.fullmatch(scope["path"]) is not None
    )
