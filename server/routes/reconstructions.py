"""Route that restarts the reconstruction of a scene from its first frame."""

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
    """Restarts the reconstruction of a scene, e.g. after a first frame that failed or has poor quality.

    The new reconstruction replaces the previous one; its committed states and exports are deleted. All frames
    whose images are still stored are reconstructed again in order. The restart is on disk when the response is sent.
    Repeating the request returns the same response.
    """
    asked = request or ReconstructionRequest()
    with setting_problems():
        settings = changed(scene.spec.settings, asked.settings)
    await check_settings(scene.request, settings, server, scenes.placement)
    begun = scene.ledger.reconstruction < n
    status = await scenes.begin_again(scene, NewReconstruction(n, asked, settings, scene.rig))
    if begun:
        await exports.forget(scene.id)
    return status
