"""Create, list, inspect, pause, resume, delete scenes."""

from __future__ import annotations

from fastapi import APIRouter, Response

from client.wire import SceneCreate, SceneList, SceneStatus
from scas4d_core.cameras import CameraError
from scas4d_core.presets import SettingError, preset
from scas4d_core.settings import Settings
from server.health import devices, estimate
from server.http import validation
from server.problems import Problem
from server.routes.access import AllScenes, TheScene, TheSettings

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])


def scene_settings(request: SceneCreate) -> Settings:
    """The preset with the request's changes."""
    try:
        return preset(request.preset, request.settings)
    except SettingError as error:
        if error.validation is not None:
            raise validation.first_of(error.validation, model=Settings, prefix="settings") from None
        raise Problem(
            422, f"there is no preset {request.preset!r}", field="preset", value=request.preset, remedy=error.remedy
        ) from None


def check_unit(request: SceneCreate, settings: Settings) -> None:
    """Refuses a unit that the rig cannot tell."""
    unit = settings.scene.metres_per_unit
    try:
        request.rig.rig().world_frame(unit)
    except CameraError as error:
        what, _, remedy = str(error).partition("; ")
        raise Problem(422, what, field="settings.scene.metres_per_unit", value=unit, remedy=remedy) from None


@router.post("", status_code=201)
async def create(request: SceneCreate, scenes: AllScenes, server: TheSettings, response: Response) -> SceneStatus:
    """Creates a scene from a rig; it waits for its first frame."""
    settings = scene_settings(request)
    for camera in request.rig.cameras:
        pixels = camera.width * camera.height
        if pixels > server.max_image_pixels:
            raise Problem(
                422,
                f"camera {camera.name!r} has {pixels} pixels, more than {server.max_image_pixels}",
                field="rig.cameras",
                value=f"{camera.width}x{camera.height}",
                remedy="send smaller pictures with the intrinsics to match, or raise SCAS4D_MAX_IMAGE_PIXELS",
            )
    check_unit(request, settings)
    estimate.check(request.rig, settings, server)
    await devices.require(settings.device)
    scene = await scenes.create(request, settings)
    response.headers["Location"] = f"/v1/scenes/{scene.id}"
    return scene.status()


@router.get("")
async def listed(scenes: AllScenes) -> SceneList:
    """All scenes; 503 while those of an earlier run are being recovered."""
    scenes.check_recovered()
    return SceneList(scenes=[scene.status() for scene in scenes.by_id.values()])


@router.get("/{id}")
async def inspect(scene: TheScene) -> SceneStatus:
    """The scene's state, progress and queue."""
    return scene.status()


@router.post("/{id}/pause")
async def pause(scene: TheScene) -> SceneStatus:
    """Frames are taken and none is reconstructed, after the one at work; holds over a restart of the service."""
    await scene.pause(True)
    return scene.status()


@router.post("/{id}/resume")
async def resume(scene: TheScene) -> SceneStatus:
    """The scene goes on with the frames that wait."""
    await scene.pause(False)
    return scene.status()


@router.delete("/{id}", status_code=204)
async def delete(scene: TheScene, scenes: AllScenes) -> None:
    """Ends the scene and removes all it has on disk."""
    await scenes.delete(scene.id)
