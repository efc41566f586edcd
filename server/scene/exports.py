"""Exports of scenes, which run one at a time in a separate process; their files expire after a day.

Exports are tracked in memory only, but their files are in the data folder. Files left by an earlier run of the service
are therefore removed at startup. An export does not wake a sleeping scene, because it reads only the scene's folder.
"""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import shutil
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

from client.wire import ExportModel, ExportRequest, ExportState
from client.wire.exports import SUFFIXES
from scas4d_core.errors import message_of
from server.messages import DamageFound, ExportProgressed, ExportSpec
from server.problems import Problem, count_noun
from server.processes import exporter
from server.processes.background_job import wait_for_job
from server.processes.placement import Placement
from server.scene.scene import Scene
from server.scene.scenes import Scenes
from server.storage.disk import free_bytes
from server.storage.layout import DataFolder

MAX_WAITING = 16
"""Maximum number of unfinished exports across all scenes; further requests get 429."""
MAX_PER_SCENE = 8
"""Maximum number of waiting, running and finished exports per scene; further requests get 409.

Equally many failed or cancelled exports are remembered.
"""
KEEP_S = 24 * 3600.0
"""Time in seconds for which an exported file is kept."""
BYTES_PER_GAUSSIAN = {"ply": 68, "splat": 32, "spz": 20, "spz4": 20, "glb": 70, "usd": 120, "tracks": 60, "s4d": 12}
"""Approximate bytes per Gaussian and frame of each format, without view-dependent colour; other formats are small."""
BYTES_PER_PIXEL = {"tapvid-mv": 5}
"""Approximate bytes per pixel, frame and camera of formats with images."""
MEDIA_TYPES = {".zip": "application/zip", ".glb": "model/gltf-binary", ".csv": "text/csv"}
FINAL_STATES = frozenset({ExportState.DONE, ExportState.FAILED, ExportState.CANCELLED})

log = logging.getLogger("scas4d.server")


@dataclass(eq=False)
class Export:
    """State of one export.

    Attributes:
        id: export ID.
        spec: specification for the export process.
        name: suggested name for the downloaded file.
        created: time of the request.
        state: current state.
        done: number of frames exported so far.
        size: size on disk in bytes.
        error: reason for a failure, or None.
        ended: time when the export finished, or None.
        timer: timer that removes the finished export when it expires.
        task: task that runs the export.
    """

    id: str
    spec: ExportSpec
    name: str
    created: datetime
    state: ExportState = ExportState.WAITING
    done: int = 0
    size: int = 0
    error: str | None = None
    ended: datetime | None = None
    timer: asyncio.TimerHandle | None = None
    task: asyncio.Task[None] | None = field(default=None, repr=False)

    @property
    def scene(self) -> str:
        """ID of the scene."""
        return self.spec.scene.folder.name

    @property
    def media_type(self) -> str:
        """Media type of the exported file."""
        return MEDIA_TYPES.get(self.spec.file.suffix, "application/octet-stream")

    def model(self) -> ExportModel:
        """Returns the export as a model of the HTTP API."""
        place = f"/v1/scenes/{self.scene}/exports/{self.id}"
        return ExportModel.model_validate(
            {
                "id": self.id,
                "scene": self.scene,
                "format": self.spec.format,
                "first": self.spec.frames[0],
                "last": self.spec.frames[-1],
                "state": self.state,
                "done": self.done,
                "frames": len(self.spec.frames),
                "bytes": self.size,
                "error": self.error,
                "created": self.created.isoformat(),
                "expires": None if self.ended is None else (self.ended + timedelta(seconds=KEEP_S)).isoformat(),
                "name": self.name,
                "file": f"{place}/file" if self.state == ExportState.DONE else None,
            }
        )


class Exports:
    """All exports of the service. Its methods must be called on the event loop.

    Args:
        scenes: the service's scene registry.
        placement: placement used to start the export processes.
    """

    def __init__(self, scenes: Scenes, placement: Placement) -> None:
        self._scenes = scenes
        self._folder = DataFolder(scenes.server.data.resolve()).exports
        self._placement = placement
        self._turns = asyncio.Semaphore(1)
        self._known: dict[str, dict[str, Export]] = {}

    async def open(self) -> None:
        """Removes files left by an earlier run of the service.

        The caller must hold the lock of the data folder.
        """
        await asyncio.to_thread(shutil.rmtree, self._folder, ignore_errors=True)

    def of(self, scene: str) -> list[Export]:
        """Returns the exports of a scene, oldest first.

        Raises:
            Problem: 404 if the scene does not exist; 503 if it is not available yet.
        """
        self._scenes.status(scene)
        return list(self._known.get(scene, {}).values())

    def get(self, scene: str, export: str) -> Export:
        """Returns an export by its ID.

        Raises:
            Problem: 404 if the export does not exist.
        """
        self._scenes.status(scene)
        known_export = self._known.get(scene, {}).get(export)
        if known_export is None:
            remedy = f"list the exports with GET /v1/scenes/{scene}/exports, or start a new one if it was removed"
            raise Problem(404, f"the scene has no export {export!r}", field="export", value=export, remedy=remedy)
        return known_export

    def begin(self, scene: Scene, request: ExportRequest, frames: tuple[int, ...]) -> Export:
        """Queues an export of committed frames.

        Args:
            scene: scene to export.
            request: validated request.
            frames: indices of the frames, in ascending order.

        Raises:
            Problem: 409 if the scene has too many exports; 429 if too many exports of the service
                are unfinished; 503 if the reconstruction was restarted after the request had
                arrived; 507 if there is not enough disk space.
        """
        self._scenes.check_current(scene)
        self._check(scene, request, len(frames))
        known = self._known.setdefault(scene.id, {})
        id = secrets.token_hex(6)
        suffix = SUFFIXES[request.format]
        folder = self._folder / scene.id / id
        spec = ExportSpec(
            scene.spec,
            folder / f"export{suffix}",
            request.format,
            scene.committed[0],
            frames,
            None if request.ids is None else tuple(request.ids),
        )
        title = re.sub(r"[^A-Za-z0-9]+", "-", scene.status().name).strip("-")[:40] or scene.id[:8]
        name = f"{title}-{frames[0]:06d}-{frames[-1]:06d}-{request.format}{suffix}"
        known[id] = export = Export(id, spec, name, datetime.now(UTC))
        export.task = asyncio.create_task(self._run_in_turn(export))
        return export

    def _check(self, scene: Scene, request: ExportRequest, frames: int) -> None:
        """Raises a ``Problem`` if there are too many exports, or too little disk space for this one."""
        id = scene.id
        waiting = [one for each in self._known.values() for one in each.values() if one.state not in FINAL_STATES]
        if len(waiting) >= MAX_WAITING:
            raise Problem(
                429,
                f"the service already has the maximum of {count_noun(len(waiting), 'unfinished export')}",
                field="id",
                value=id,
                remedy="try again after one has finished",
                headers={"Retry-After": "10"},
            )
        kept = [
            one
            for one in self._known.get(id, {}).values()
            if one.state not in FINAL_STATES or one.state == ExportState.DONE
        ]
        if len(kept) >= MAX_PER_SCENE:
            raise Problem(
                409,
                f"the scene already has the maximum of {count_noun(len(kept), 'export')}",
                field="id",
                value=id,
                remedy=f"remove one with DELETE /v1/scenes/{id}/exports/EXPORT, such as {kept[0].id}",
            )
        parent = self._folder.parent
        pixels = sum(camera.width * camera.height for camera in scene.rig.cameras)
        per_frame = (
            BYTES_PER_GAUSSIAN.get(request.format, 0) * (scene.status().gaussians or 0)
            + BYTES_PER_PIXEL.get(request.format, 0) * pixels
        )
        copies = 2 if request.format in exporter.WRITTEN_TWICE else 1
        needed = copies * per_frame * frames + exporter.RESERVE_BYTES
        if (free := free_bytes(parent)) < needed:
            raise Problem(
                507,
                f"the disk has {free / 1e6:.0f} MB free, of which {exporter.RESERVE_BYTES / 1e6:.0f} MB are reserved "
                f"for frames; the export takes about {(needed - exporter.RESERVE_BYTES) / 1e6:.1f} MB",
                field="last",
                value=request.last,
                remedy="export fewer frames, choose a smaller format (s4d), or remove finished exports",
            )

    async def _run_in_turn(self, export: Export) -> None:
        """Waits for the export's turn, runs its process and records the outcome."""
        folder, fault = export.spec.file.parent, None
        try:
            async with self._turns:
                await asyncio.to_thread(folder.mkdir, parents=True)
                export.state = ExportState.RUNNING
                receive = partial(self._on_message, export)
                fault = await wait_for_job(self._placement, exporter.main, export.spec, receive, "export")
            if fault is None:
                export.size = (await asyncio.to_thread(export.spec.file.stat)).st_size
        except Exception as error:
            log.exception("scene %s: an export failed", export.scene)
            fault = f"internal error: {type(error).__name__}: {message_of(error)}"
        if fault is not None:
            log.warning("scene %s: export %s failed: %s", export.scene, export.id, fault)
            await self._remove_files(folder)
        self._finish(export, ExportState.DONE if fault is None else ExportState.FAILED, fault)

    def _finish(self, export: Export, state: ExportState, error: str | None) -> None:
        export.state, export.error, export.ended = state, error, datetime.now(UTC)
        export.size = export.size if state == ExportState.DONE else 0
        export.timer = asyncio.get_running_loop().call_later(KEEP_S, self._expire, export)
        known = self._known.get(export.scene, {}).values()
        failed = [one for one in known if one.state in (ExportState.FAILED, ExportState.CANCELLED)]
        for one in failed[:-MAX_PER_SCENE]:
            self._drop(one)

    def _on_message(self, export: Export, message: Any) -> None:
        match message:
            case ExportProgressed():
                export.done, export.size = message.done, message.size
            case DamageFound():
                scene = self._scenes.awake.get(export.scene)
                if scene is not None and scene.has_place:  # for a sleeping scene, the next scrub finds the damage
                    scene.repair_queue.report_damage(message.files)

    def _drop(self, export: Export) -> None:
        """Removes a finished export from the list and cancels its timer."""
        known = self._known.get(export.scene, {})
        if known.get(export.id) is export:
            del known[export.id]
        if not known:
            self._known.pop(export.scene, None)
        if export.timer is not None:
            export.timer.cancel()

    def _expire(self, export: Export) -> None:
        self._drop(export)
        asyncio.get_running_loop().run_in_executor(None, partial(shutil.rmtree, export.spec.file.parent, True))

    async def remove(self, scene: str, export: str) -> None:
        """Cancels a waiting or running export, or removes a finished one and its file.

        Raises:
            Problem: 404 if the export does not exist.
        """
        removed = self.get(scene, export)
        if removed.state in FINAL_STATES:
            self._drop(removed)
            await self._remove_files(removed.spec.file.parent)
        else:
            await self._cancel(removed)

    async def forget(self, scene: str) -> None:
        """Cancels and removes all exports of a scene that was deleted or whose reconstruction was restarted."""
        for export in list(self._known.get(scene, {}).values()):
            await self._cancel(export)
            self._drop(export)
        await self._remove_files(self._folder / scene)

    async def stop(self) -> None:
        """Stops all export processes; their files will be removed at the next startup."""
        for known in list(self._known.values()):
            for export in list(known.values()):
                await self._cancel(export)
                if export.timer is not None:
                    export.timer.cancel()

    async def _cancel(self, export: Export) -> None:
        """Cancels a waiting or running export."""
        if export.task is not None and not export.task.done():
            export.task.cancel()
            await asyncio.wait({export.task})
        if export.state not in FINAL_STATES:  # otherwise it finished before the cancellation
            self._finish(export, ExportState.CANCELLED, "the export was cancelled")
            await self._remove_files(export.spec.file.parent)

    async def _remove_files(self, folder: Path) -> None:
        await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
