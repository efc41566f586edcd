"""Calls on scenes: create, read, edit, pause, resume, put to sleep, begin again, delete; points of frame 0."""

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
    SceneList,
    SceneStatus,
)
from client.wire.estimate import SceneEstimate
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
    """Creates a scene. The request is never sent twice: that would make two.

    Args:
        rig: its cameras, at the size of the pictures that will be sent.
        name: for people; the service makes the id.
        preset: named settings.
        settings: what differs from the preset, nested.
        frames_per_second: frame n without a time of its own is taken at n / frames_per_second.
        ingest: how the scene takes frames, and what it keeps of them.
        nodes: labels that a node of the cluster must have to run its processes.

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
    """Estimates the memory and disk that a scene would take; arguments as `create_scene`, and nothing is created.

    >>> found = client.estimate(rig)
    >>> found.memory_mb < found.limit_mb
    True
    """
    request = SceneCreate(rig=RigModel.of(rig), preset=preset, settings=dict(settings or {}))
    return Call("POST", "/v1/estimate", json_reader(SceneEstimate), arguments=body(request))


def scenes() -> Call[list[SceneStatus]]:
    """Reads the status of all scenes, oldest first.

    >>> scene in [status.id for status in client.scenes()]
    True
    """
    return Call("GET", path(), lambda response: SceneList.model_validate_json(response.content).scenes)


def scene(id: str) -> Call[SceneStatus]:
    """Reads a scene's state, progress and queue.

    >>> client.scene(scene).committed
    3
    """
    return Call("GET", path(id), json_reader(SceneStatus))


def rig(id: str) -> Call[Rig]:
    """Reads a scene's cameras.

    >>> client.rig(scene).names
    ('c0', 'c1')
    """
    return Call("GET", path(id, "rig"), lambda response: RigModel.model_validate_json(response.content).rig())


def pause(id: str) -> Call[SceneStatus]:
    """Pauses a scene after the frame at work: it takes frames, and reconstructs none.

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
    """Renames a scene, archives it or takes that back, or changes what it keeps; what is None stays.

    Args:
        id: of the scene. name: for people.
        archived: True: it takes no further frames, and sleeps unless it is looked at.
        keep_frames, keep_states: rules for pictures and committed states, as in `IngestSettings`; they hold at once.
        exact_states: so many newest states stay exact, older ones go to compact files.

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
    """Ends the processes of an idle scene; it wakes by itself when it is asked or sent something.

    >>> new = client.create_scene(rig)
    >>> client.put_to_sleep(new.id).asleep
    True
    >>> client.delete_scene(new.id)
    """
    return Call("POST", path(id, "sleep"), json_reader(SceneStatus))


def delete_scene(id: str) -> Call[None]:
    """Ends a scene and removes all it has on disk.

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
    """Begins the reconstruction of a scene anew, after a first frame that failed or came out poor.

    Frames from the first one on are updated again, as far as their pictures are held; ids begin anew.

    Args:
        id: of the scene.
        n: number of the new reconstruction, `scene(id).reconstruction + 1`: so it is begun once, however often this is
            sent.
        settings: what changes of the scene's settings, nested.
        frame: to begin with, here or still to come; None: as before. Earlier frames fail.
        points: begin from the scene's points (`put_points`), False: from the pictures alone.
        discard: drop committed states; must be True where a frame after the first is committed.

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
    """Sends the initial points of frame 0; to be sent before it.

    Args:
        id: of the scene. points: in the rig's world and units.
        reconstruction: number of the one that is to begin from them (`begin_again`); None: the scene's own.

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
