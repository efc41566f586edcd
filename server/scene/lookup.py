"""What is asked for of a scene by name or number, found; or the problem that says what there is."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from client.wire import FrameReportModel, FrameState
from scas4d_core.cameras import Camera
from server.problems import Problem
from server.scene import reports

if TYPE_CHECKING:
    from server.scene.scene import Scene


def camera_of(scene: Scene, name: str) -> Camera:
    """A camera of the rig by name."""
    if name not in scene.rig.names:
        raise Problem(
            422,
            f"the rig has no camera {name!r}",
            field="camera",
            value=name,
            remedy=f"name one of {', '.join(scene.rig.names)}, or give the camera itself",
        )
    return scene.rig[name]


def committed_frame_of(scene: Scene, index: int | None, field: str) -> int:
    """The index, or the last one for None, checked to be committed."""
    if not scene.committed:
        raise Problem(
            409,
            "no frame of this scene is committed yet",
            field=field,
            remedy="wait until `committed` in the scene's status is above 0",
            state=scene.state,
        )
    if index is None:
        return scene.committed[-1]
    entry = scene.frames.get(index)
    if entry is not None and entry.unreadable:
        raise Problem(
            503,
            f"the state of frame {index} was damaged on disk and is being made again",
            field=field,
            value=index,
            remedy="ask again, or for another frame",
            headers={"Retry-After": "2"},
        )
    if entry is not None and entry.deleted and entry.error is not None:
        raise Problem(404, entry.error, field=field, value=index, remedy=_another(scene))
    if entry is None or entry.state != FrameState.COMMITTED or entry.deleted:
        state = "not here" if entry is None else entry.state.value
        said = "deleted by the scene's retention" if entry is not None and entry.deleted else state
        raise Problem(
            404,
            f"frame {index} is {said}; only committed frames that are kept can be read",
            field=field,
            value=index,
            remedy=_another(scene),
        )
    return index


def _another(scene: Scene) -> str:
    return f"ask for a committed frame, {scene.committed[0]} to {scene.committed[-1]}"


async def report_of(scene: Scene, files: reports.ReportFiles, index: int) -> FrameReportModel | None:
    """What became of a frame, its numbers read from disk where they are not in memory; None: it is not known."""
    entry = scene.frames.get(index)
    if entry is None:
        parts = scene.ledger.open.get(index)
        if parts is None:
            return None
        return FrameReportModel(
            scene=scene.id, index=index, time=parts.time, state=FrameState.OPEN, received=parts.cameras, held=True
        )
    found = entry.report
    if found.state == FrameState.COMMITTED and not found.deleted and not entry.measured:
        numbers = await asyncio.to_thread(files.read, index)
        if faults := await asyncio.to_thread(files.take_faults):
            scene.mending.noticed(faults)
        reports.fill(found, numbers)
        scene.frames.remember(index, numbers)
    return found
