"""Routes that create, list, inspect, edit, pause, resume, restart, put to sleep and delete scenes."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

from fastapi import APIRouter, Path, Request, Response

from client.wire import ReconstructionRequest, RigModel, SceneCreate, SceneEdit, SceneList, SceneStatus
from scas4d_core.cameras import CameraError
from scas4d_core.engines.choose import free_gpu_mb, gpu_fault
from scas4d_core.presets import SettingError, changed, preset
from scas4d_core.rig_checks import RigError, check_scene
from scas4d_core.settings import Settings
from server.health import estimate
from server.http import validation
from server.http.permissions import ALL, PERMISSION, Permission
from server.peers.peers import PROXIED_HEADER, Peers
from server.problems import Problem, rig_problem
from server.processes.placement import Placement
from server.routes.access import AllExports, AllScenes, SceneId, TheRecord, TheScene, TheSettings
from server.scene.new_reconstruction import NewReconstruction
from server.settings import ServerSettings

router = APIRouter(prefix="/v1/scenes", tags=["scenes"])

Number = Annotated[int, Path(ge=1, le=1_000_000_000, description="The scene's `reconstruction` + 1.")]


def scene_settings(request: SceneCreate) -> Settings:
    """Returns the settings of the requested preset with the changes of the request applied."""
    with setting_problems():
        return preset(request.preset, request.settings)


@contextmanager
def setting_problems() -> Iterator[None]:
    """Converts errors in settings to `Problem`."""
    try:
        yield
    except SettingError as error:
        if error.validation is not None:
            raise validation.first_problem(error.validation, model=Settings, prefix="settings") from None
        unknown = error.setting == "preset"
        fault = f"unknown preset {error.value!r}" if unknown else error.fault
        field = error.setting if unknown else f"settings.{error.setting}"
        raise Problem(422, fault, field=field, value=str(error.value), remedy=error.remedy) from None


def check_rig(request: SceneCreate, settings: Settings) -> None:
    """Raises `Problem` if the settings do not fit the rig, or the rig does not determine the unit 'auto'."""
    unit, rig = settings.scene.metres_per_unit, request.rig.rig()
    try:
        rig.world_frame(unit)
        check_scene(rig, settings.scene)
    except RigError as error:
        raise rig_problem(error) from None
    except CameraError as error:
        field = "settings.scene.metres_per_unit"
        raise Problem(422, error.fault, field=field, value=unit, remedy=error.remedy) from None


def check_nodes(request: SceneCreate, placement: Placement) -> None:
    """Raises `Problem` if node labels are given but all scenes run on the service's own machine."""
    if request.nodes and not placement.has_labels:
        raise Problem(
            422,
            "this service runs all scenes on its own machine, which has no labels",
            field="nodes",
            value=request.nodes,
            remedy="omit it, or run the service on a cluster: scas4d serve --placement ray",
        )


async def check_device(settings: Settings, placement: Placement) -> None:
    """Raises `Problem` if the scene requires a GPU that this machine lacks; other machines are not checked."""
    if settings.device != "gpu" or placement.has_labels:
        return
    if fault := await asyncio.to_thread(gpu_fault):  # may initialize CUDA
        remedy = "use 'auto' or 'cpu', or see docs/gpu.md"
        raise Problem(422, f"no usable GPU: {fault}", field="settings.device", value="gpu", remedy=remedy)


async def check_settings(
    request: SceneCreate, settings: Settings, server: ServerSettings, placement: Placement
) -> None:
    """Raises `Problem` if the settings do not fit the rig or the machine, or the scene exceeds the memory limit."""
    check_rig(request, settings)
    await check_device(settings, placement)
    estimate.refuse_if_too_large(request.rig, settings, server)


@router.post("", status_code=201)
async def create(request: SceneCreate, scenes: AllScenes, server: TheSettings, response: Response) -> SceneStatus:
    """Creates a scene from a rig; the scene then waits for its first frame."""
    settings = scene_settings(request)
    for camera in request.rig.cameras:
        pixels = camera.width * camera.height
        if pixels > server.max_image_pixels:
            raise Problem(
                422,
                f"camera {camera.name!r} has {pixels} pixels, more than the maximum of {server.max_image_pixels}",
                field="rig.cameras",
                value=f"{camera.width}x{camera.height}",
                remedy="send smaller images with matching intrinsics, or raise SCAS4D_MAX_IMAGE_PIXELS",
            )
    check_nodes(request, scenes.placement)
    await check_settings(request, settings, server, scenes.placement)
    if settings.device != "cpu" and not scenes.placement.has_labels:
        free = await asyncio.to_thread(free_gpu_mb)  # may initialize CUDA
        settings = estimate.fit_gpu(request.rig, settings, server, free)
    scene = await scenes.create(request, settings)
    response.headers["Location"] = f"/v1/scenes/{scene.id}"
    return scene.status()


@router.get("")
async def listed(scenes: AllScenes, request: Request, response: Response) -> SceneList:
    """Lists all scenes without waking them; a share link lists only its own scene.

    The response is 503 while scenes of an earlier run are being recovered. On a cluster, the list includes the scenes
    of the other services. The header X-Unreachable names services that do not respond.
    """
    scenes.recovering.check()
    permission: Permission = request.scope.get(PERMISSION, ALL)
    summaries = scenes.statuses()
    peers: Peers | None = request.app.state.peers
    if peers is not None and PROXIED_HEADER not in request.headers:
        others, silent = await peers.scenes(permission)
        summaries = sorted([*summaries, *others], key=lambda status: status.created)
        if silent:
            response.headers["X-Unreachable"] = ", ".join(silent)
    return SceneList(scenes=[status for status in summaries if permission.scene in (None, status.id)])


@router.get("/{id}")
async def inspect(id: SceneId, scenes: AllScenes) -> SceneStatus:
    """Returns the state, progress and queue of the scene without waking it."""
    return scenes.status(id)


@router.get("/{id}/rig")
async def rig(scene: TheRecord) -> RigModel:
    """Returns the camera rig of the scene as uploaded, without calibration corrections."""
    return scene.request.rig


@router.patch("/{id}")
async def edit(id: SceneId, scenes: AllScenes, request: SceneEdit) -> SceneStatus:
    """Renames, archives or unarchives the scene, or changes how many images and states it keeps.

    The change is on disk when the response is sent. Reducing `keep_states` wakes the scene and permanently deletes
    states within seconds.
    """
    async with scenes.use(id, place=request.keep_states is not None or request.exact_states is not None) as scene:
        await scene.edit(request)
        return scene.status()


@router.post("/{id}/pause")
async def pause(scene: TheRecord) -> SceneStatus:
    """Pauses the scene after the current frame: frames are accepted but not reconstructed, even after a restart."""
    await scene.pause(True)
    return scene.status()


@router.post("/{id}/resume")
async def resume(scene: TheScene) -> SceneStatus:
    """Resumes the scene with the queued frames."""
    await scene.pause(False)
    return scene.status()


@router.put("/{id}/reconstructions/{n}")
async def put(
    scene: TheScene,
    n: Number,
    scenes: AllScenes,
    server: TheSettings,
    exports: AllExports,
    request: ReconstructionRequest | None = None,
) -> SceneStatus:
    """Restarts the reconstruction of a scene, for example after a first frame that failed or has poor quality.

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


@router.post("/{id}/sleep")
async def put_to_sleep(id: SceneId, scenes: AllScenes) -> SceneStatus:
    """Stops the processes of an idle scene, which wakes up automatically on the next request or frame."""
    if (scene := scenes.awake.get(id)) is not None:
        if not scene.idle:
            raise Problem(
                409,
                "the scene is not idle: frames are waiting, or a client, viewer or sender is connected",
                field="id",
                value=id,
                remedy="wait until its frames are processed, and disconnect its viewers and senders",
            )
        await scenes.put_to_sleep(scene)
    return scenes.status(id)


@router.delete("/{id}", status_code=204)
async def delete(id: SceneId, scenes: AllScenes, exports: AllExports) -> None:
    """Stops the scene and deletes its data on disk and its exports."""
    await scenes.delete(id)
    await exports.forget(id)
