"""Permissions: what the bearer of a token may do. Those who may only read change nothing and send no frames."""

from __future__ import annotations

import re
from typing import NamedTuple

from starlette.types import Scope

from server.problems import Problem

READS = re.compile(r"/v1/(tickets|estimate|scenes/[^/]+/(render|tracks/query))")
"""Addresses whose POST changes nothing: the question is in the body."""
READ_SOCKETS = re.compile(r"/v1/scenes/[^/]+/stream")
"""WebSockets that only send."""


class Permission(NamedTuple):
    """A bearer may change things, or only read; all scenes, or one; until `end`, seconds since the epoch, or always."""

    write: bool = False
    scene: str | None = None
    end: int | None = None


ALL = Permission(write=True)
PERMISSION = "scas4d.permission"
"""Where the scope of a request has it."""


def check(permission: Permission, scope: Scope) -> None:
    """Refuses what the bearer may not do.

    Raises:
        Problem: 403; 404 for another scene than the one that may be read: the bearer does not learn whether it exists.
    """
    path, reading = scope["path"], _reads(scope)
    if permission.scene is not None:
        own = f"/v1/scenes/{permission.scene}"
        if path != own and not path.startswith((own + "/", "/v1/tickets")) and path != "/v1/scenes":
            raise Problem(
                404,
                "this link shows one scene, and no other address",
                field="path",
                value=path,
                remedy=f"ask for {own}, or send the token of the service",
            )
    if not (permission.write or reading):
        raise Problem(
            403,
            "this token may only read",
            field="Authorization",
            remedy="send the token that the service was started with, SCAS4D_TOKEN",
        )


def _reads(scope: Scope) -> bool:
    if scope["type"] == "websocket":
        return READ_SOCKETS.fullmatch(scope["path"]) is not None
    return scope["method"] in ("GET", "HEAD", "OPTIONS") or (
        scope["method"] == "POST" and READS.fullmatch(scope["path"]) is not None
    )
