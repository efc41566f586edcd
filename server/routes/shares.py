"""Route that issues read-only tokens and share links."""

from __future__ import annotations

import time
from datetime import UTC, datetime

from fastapi import APIRouter, Request

from client.wire import Share, ShareRequest
from server.http.sharing import Sharing
from server.peers.peers import Peers
from server.problems import Problem
from server.routes.access import AllScenes, TheSettings

router = APIRouter(prefix="/v1/shares", tags=["service"])


@router.post("", status_code=201)
async def share(request: ShareRequest, scenes: AllScenes, settings: TheSettings, asked: Request) -> Share:
    """Creates a read-only token for one scene or all scenes, and a link that opens the viewer with this token.

    The token cannot be revoked: it expires, or becomes invalid when the token of the service changes.
    """
    secret = settings.secret
    if secret is None:
        raise Problem(
            409,
            "the service has no token: anyone who can reach it has full access",
            field="SCAS4D_TOKEN",
            remedy="start it with SCAS4D_TOKEN; others then need a token or a link",
        )
    if request.scene is not None:
        peers: Peers | None = asked.app.state.peers
        if request.scene in scenes or peers is None or await peers.owner(request.scene) is None:
            scenes.status(request.scene)  # 404 if it does not exist
    end = int(time.time() + request.seconds)
    token = Sharing(secret).issue(request.scene, end)
    shown = f"scene={request.scene}&" if request.scene is not None else ""
    return Share(
        token=token,
        scene=request.scene,
        ends=datetime.fromtimestamp(end, UTC).isoformat(),
        address=f"/#{shown}token={token}",
    )
