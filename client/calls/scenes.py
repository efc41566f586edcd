"""Calls that create, read, edit, pause, resume, put to sleep, restart and delete scenes, and upload initial points."""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from client.calls.call import NPZ, Call, body, json_reader, nothing, path
from client.wire import (
    IngestSettings,
    PointsReceipt,
    ReconstructionRequest,
    Retention,
    RigModel,
    SceneCreate,
    SceneEdit,
    SceneEstimate,
    SceneList,
    SceneStatus,
)
from scas4d_core.cameras import Rig
from scas4d_core.captures import InitialPoints


def create_scene(
    rig: Rig,
    *,
    name: str = "",
    preset: str = "scas4d",
    settings: Mapping[str, Any] | None = None,
    frames_per_second: float = 30.0,
    ingest: IngestSettings | None = None,
    nodes: Mapping[str, str] | None = None,
) -> Call[SceneStatus]:
    """Creates a scene; the request is not retried once it has been sent, because that could create two scenes.

    Args:
        rig: camera rig, calibrated for the resolution of the images that will be sent.
        name: display name; the service assigns the id.
        preset: settings preset name.
        settings: nested settings that override the preset.
        frames_per_second: frame rate; frame n without a timestamp gets the time n / frames_per_second.
        ingest: rules for accepting frames and retaining data; None for the defaults.
        nodes: labels that a cluster node must have in order to run the scene's processes.

    >>> new = client.create_scene(rig, name="studio", settings={"update": {"iterations": 50}})
    >>> new.state, new.settings["update"]["iterations"]
    (<SceneState.AWAITING: 'awaiting_first_frame'>, 50)
    >>> client.delete_scene(new.id)
    """
    request = SceneCreate(
        rig=RigModel.of(rig),
        name=name,
        preset=preset,
        settings=dict(settings or {}),
        frames_per_second=frames_per_second,
        ingest=ingest or IngestSettings(),
        nodes=dict(nodes or {}),
    )
    return Call("POST", path(), json_reader(SceneStatus), repeatable=False, arguments=body(request))


def estimate(rig: Rig, *, preset: str = "scas4d", settings: Mapping[str, Any] | None = None) -> Call[SceneEstimate]:
    """Returns the estimated memory and disk usage of a scene without creating it; arguments as for `create_scene`.

    >>> found = client.estimate(rig)
    >>> found.memory_mb < found.limit_mb
    True
    """
    request = SceneCreate(rig=RigModel.of(rig), preset=preset, settings=dict(settings or {}))
    return Call("POST", "/v1/estimate", json_reader(SceneEstimate), arguments=body(request))


def scenes() -> Call[list[SceneStatus]]:
    """Returns the status of all scenes, oldest first.

    >>> scene in [status.id for status in client.scenes()]
    True
    """
    return Call("GET", path(), lambda response: SceneList.model_validate_json(response.content).scenes)


def scene(id: str) -> Call[SceneStatus]:
    """Returns a scene's state, progress and queue.

    >>> client.scene(scene).committed
    3
    """
    return Call("GET", path(id), json_reader(SceneStatus))


def rig(id: str) -> Call[Rig]:
    """Returns a scene's camera rig.

    >>> client.rig(scene).names
    ('c0', 'c1')
    """
    return Call("GET", path(id, "rig"), lambda response: RigModel.model_validate_json(response.content).rig())


def pause(id: str) -> Call[SceneStatus]:
    """Pauses a scene after the current frame; it accepts frames but does not reconstruct them.

    >>> client.pause(scene).paused
    True
    >>> client.resume(scene).paused
    False
    """
    return Call("POST", path(id, "pause"), json_reader(SceneStatus))


def resume(id: str) -> Call[SceneStatus]:
    """Resumes a paused scene.

    >>> client.resume(scene).paused
    False
    """
    return Call("POST", path(id, "resume"), json_reader(SceneStatus))


def edit_scene(
    id: str,
    *,
    name: str | None = None,
    archived: bool | None = None,
    keep_frames: Retention | None = None,
    keep_states: Retention | None = None,
    exact_states: int | None = None,
) -> Call[SceneStatus]:
    """Renames, archives or unarchives a scene, or changes its retention rules; None leaves a value unchanged.

    Args:
        id: scene id.
        name: display name.
        archived: whether to archive the scene, which then refuses frames and sleeps unless it is viewed.
        keep_frames, keep_states: retention rules for images and committed states, as in `IngestSettings`; changes take
            effect immediately.
        exact_states: number of newest states to store exactly; older states are moved to compact files.

    >>> from client.wire import Retention
    >>> new = client.create_scene(rig)
    >>> client.edit_scene(new.id, name="rehearsal", keep_frames=Retention(last=8)).name
    'rehearsal'
    >>> client.delete_scene(new.id)
    """
    edit = SceneEdit(
        name=name, archived=archived, keep_frames=keep_frames, keep_states=keep_states, exact_states=exact_states
    )
    return Call("PATCH", path(id), json_reader(SceneStatus), arguments=body(edit))


def put_to_sleep(id: str) -> Call[SceneStatus]:
    """Stops the processes of an idle scene; it wakes automatically on the next request or frame.

    >>> new = client.create_scene(rig)
    >>> client.put_to_sleep(new.id).asleep
    True
    >>> client.delete_scene(new.id)
    """
    return Call("POST", path(id, "sleep"), json_reader(SceneStatus))


def delete_scene(id: str) -> Call[None]:
    """Stops a scene and deletes all its data on disk.

    >>> new = client.create_scene(rig)
    >>> client.delete_scene(new.id)
    >>> new.id in [status.id for status in client.scenes()]
    False
    """
    return Call("DELETE", path(id), nothing)


def begin_again(
    id: str,
    n: int,
    *,
    settings: Mapping[str, Any] | None = None,
    frame: int | None = None,
    points: bool = True,
    discard: bool = False,
) -> Call[SceneStatus]:
    """Restarts the reconstruction of a scene, e.g. if the first frame failed or is of poor quality.

    All frames whose images are still stored are reconstructed again, starting with the first. Gaussian ids are
    reassigned.

    Args:
        id: scene id.
        n: number of the new reconstruction, `scene(id).reconstruction + 1`; makes the call idempotent.
        settings: nested changes to the scene's settings.
        frame: index of the first frame, already received or still to come; None keeps the current first frame. Earlier
            frames are marked as failed.
        points: whether to initialize from the scene's points (`put_points`) instead of the images alone.
        discard: whether to delete committed states; must be True if any frame after the first is committed.

    >>> new = client.create_scene(rig)
    >>> receipt = client.put_frame(new.id, 0, pictures)
    >>> report = client.wait(new.id, 0)
    >>> again = client.begin_again(new.id, 1, settings={"update": {"iterations": 50}})
    >>> again.reconstruction, again.settings["update"]["iterations"]
    (1, 50)
    >>> client.wait(new.id, 0).state
    <FrameState.COMMITTED: 'committed'>
    >>> client.delete_scene(new.id)
    """
    request = ReconstructionRequest(settings=dict(settings or {}), frame=frame, points=points, discard=discard)
    return Call("PUT", path(id, "reconstructions", n), json_reader(SceneStatus), arguments=body(request))


def put_points(id: str, points: InitialPoints, *, reconstruction: int | None = None) -> Call[PointsReceipt]:
    """Uploads the initial point cloud for frame 0; must be called before that frame is sent.

    Args:
        id: scene id.
        points: initial points in the rig's world frame and units.
        reconstruction: number of the reconstruction that starts from the points (`begin_again`); None for the current
            one.

    >>> from scas4d_core.captures import InitialPoints
    >>> new = client.create_scene(rig)
    >>> cloud = InitialPoints(positions=np.zeros((3, 3)), colours=np.full((3, 3), 0.5, np.float32))
    >>> client.put_points(new.id, cloud).points
    3
    >>> client.delete_scene(new.id)
    """
    arrays: dict[str, NDArray[Any]] = {"positions": points.positions, "colours": points.colours}
    if points.foreground is not None:
        arrays["foreground"] = points.foreground
    file = io.BytesIO()
    np.savez_compressed(file, allow_pickle=False, **arrays)
    arguments: dict[str, Any] = {"content": file.getvalue(), "headers": {"Content-Type": NPZ}}
    if reconstruction is not None:
        arguments["params"] = {"reconstruction": reconstruction}
    return Call("PUT", path(id, "points"), json_reader(PointsReceipt), arguments=arguments)
