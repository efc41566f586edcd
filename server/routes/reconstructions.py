"""Route of reconstructions: a scene begins anew from its first frame."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path

from client.wire import ReconstructionRequest, SceneStatus
from scas4d_core.presets import changed
from server.routes.access import AllExports, AllScenes, TheScene, TheSettings
from server.routes.scenes import check_settings, setting_problems
from server.scene.new_reconstruction import NewReconstruction

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])

Number = Annotated[int, Path(ge=1, le=1_000_000_000, description="The scene's `reconstruction` + 1.")]


@router.put("/{id}/reconstructions/{n}")
async def put(
    scene: TheScene,
    n: Number,
    scenes: AllScenes,
    server: TheSettings,
    exports: AllExports,
    request: ReconstructionRequest | None = None,
) -> SceneStatus:
    """Begins the reconstruction of a scene anew, after a first frame that failed or came out poor.

    It takes the place of the one before, whatever that does: its committed states and exports are dropped. All frames
    from the first one on are updated again, in order, as far as their pictures are held. It is on disk when this
    answers; the same request again gets the same answer.
    """
    asked = request or ReconstructionRequest()
    with setting_problems():
        settings = changed(scene.spec.settings, asked.settings)
    check_settings(scene.request, settings, server)
    begun = scene.ledger.reconstruction < n
    status = await scenes.begin_again(scene, NewReconstruction(n, asked, settings, scene.rig))
    if begun:
        await exports.forget(scene.id)
    return status
