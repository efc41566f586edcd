"""Exports of the scenes: one at a time in a process of its own, the others wait; files go after a while.

An export is known to this process alone, and its file lies in the data folder: what an earlier process left is removed
at the start. A scene that sleeps sleeps on: only its folder is read.
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
from server.messages import Damaged, ExportEnded, ExportProgressed, ExportSpec
from server.problems import Problem, counted
from server.processes import exporter
from server.processes.placement import Placement, ProcessExit
from server.scene.scene import Scene
from server.scene.scenes import Scenes
from server.storage.disk import free_bytes
from server.storage.layout import DataFolder

MOST_WAITING = 16
"""Exports of all scenes that are not over; more get 429."""
MOST_A_SCENE = 8
"""Exports of one scene that wait, run or are done; more get 409. Of those that failed as many are remembered."""
KEEP_S = 24 * 3600.0
"""The file of an export stays for so long."""
BYTES_EACH = {"ply": 68, "splat": 32, "spz": 20, "spz4": 20, "glb": 70, "usd": 120, "tracks": 60, "s4d": 12}
"""About so many bytes a Gaussian and frame, without gloss; USD takes its room twice. Other formats are small."""
MEDIA_TYPES = {".zip": "application/zip", ".glb": "model/gltf-binary", ".csv": "text/csv"}
OVER = frozenset({ExportState.DONE, ExportState.FAILED, ExportState.CANCELLED})

log = logging.getLogger("scas4d.server")


@dataclass(eq=False)
class Export:
    """One export.

    Attributes:
        spec: of its process. name: of the file, for those who save it. done: frames; size: bytes on disk.
        timer: removes it. task: makes it.
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
        """Id of the scene."""
        return self.spec.scene.folder.name

    @property
    def media_type(self) -> str:
        """Media type of the file."""
        return MEDIA_TYPES.get(self.spec.file.suffix, "application/octet-stream")

    def model(self) -> ExportModel:
        """The export as it goes over the wire."""
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
    """All exports of the service. On the event loop.

    Args:
        scenes: of the service. placement: starts the processes.
    """

    def __init__(self, scenes: Scenes, placement: Placement) -> None:
        self._scenes = scenes
        self._folder = DataFolder(scenes.server.data.resolve()).exports
        self._placement = placement
        self._turns = asyncio.Semaphore(1)
        self._known: dict[str, dict[str, Export]] = {}

    async def open(self) -> None:
        """Removes what an earlier process left; it holds the lock of the data folder."""
        await asyncio.to_thread(shutil.rmtree, self._folder, ignore_errors=True)

    def of(self, scene: str) -> list[Export]:
        """Lists the exports of a scene, oldest first.

        Raises:
            Problem: 404 or 503, there is no such scene.
        """
        self._scenes.status(scene)
        return list(self._known.get(scene, {}).values())

    def get(self, scene: str, export: str) -> Export:
        """Returns an export.

        Raises:
            Problem: 404, there is none.
        """
        self._scenes.status(scene)
        known_export = self._known.get(scene, {}).get(export)
        if known_export is None:
            remedy = f"GET /v1/scenes/{scene}/exports lists them; ask for a new one where it was removed"
            raise Problem(404, f"the scene has no export {export!r}", field="export", value=export, remedy=remedy)
        return known_export

    def begin(self, scene: Scene, request: ExportRequest, frames: tuple[int, ...]) -> Export:
        """Queues an export of committed frames.

        Raises:
            Problem: 409, the scene has too many; 429, too many wait; 507, the disk has too little room.
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
        export.task = asyncio.create_task(self._make(export))
        return export

    def _check(self, scene: Scene, request: ExportRequest, frames: int) -> None:
        id = scene.id
        waiting = [one for each in self._known.values() for one in each.values() if one.state not in OVER]
        if len(waiting) >= MOST_WAITING:
            raise Problem(
                429,
                f"{counted(len(waiting), 'export')} of the service not over",
                field="id",
                value=id,
                remedy="ask again when one is over",
                headers={"Retry-After": "10"},
            )
        kept = [
            one for one in self._known.get(id, {}).values() if one.state not in OVER or one.state == ExportState.DONE
        ]
        if len(kept) >= MOST_A_SCENE:
            raise Problem(
                409,
                f"the scene has {counted(len(kept), 'export')}, as many as it may",
                field="id",
                value=id,
                remedy=f"remove one: DELETE /v1/scenes/{id}/exports/EXPORT, as {kept[0].id}",
            )
        parent = self._folder.parent
        needed = BYTES_EACH.get(request.format, 0) * frames * (scene.status().gaussians or 0) + exporter.RESERVE_BYTES
        if (free := free_bytes(parent)) < needed:
            raise Problem(
                507,
                f"the disk has {free / 1e6:.0f} MB free, and {exporter.RESERVE_BYTES / 1e6:.0f} MB of it are left to "
                f"frames; the export takes about {(needed - exporter.RESERVE_BYTES) / 1e6:.1f} MB",
                field="last",
                value=frames,
                remedy="export fewer frames, a smaller format (spz, s4d), or remove exports that are done",
            )

    async def _make(self, export: Export) -> None:
        """Waits for its turn, runs the process, and notes how it ended."""
        folder, fault = export.spec.file.parent, None
        try:
            async with self._turns:
                await asyncio.to_thread(folder.mkdir, parents=True)
                export.state = ExportState.RUNNING
                fault = await self._process(export)
            if fault is None:
                export.size = (await asyncio.to_thread(export.spec.file.stat)).st_size
        except Exception as error:
            log.exception("scene %s: an export failed", export.scene)
            fault = f"the service failed: {type(error).__name__}: {message_of(error)}"
        if fault is not None:
            log.warning("scene %s: export %s failed: %s", export.scene, export.id, fault)
            await self._clear(folder)
        self._over(export, ExportState.DONE if fault is None else ExportState.FAILED, fault)

    def _over(self, export: Export, state: ExportState, error: str | None) -> None:
        export.state, export.error, export.ended = state, error, datetime.now(UTC)
        export.size = export.size if state == ExportState.DONE else 0
        export.timer = asyncio.get_running_loop().call_later(KEEP_S, self._expire, export)
        known = self._known.get(export.scene, {}).values()
        failed = [one for one in known if one.state in (ExportState.FAILED, ExportState.CANCELLED)]
        for one in failed[:-MOST_A_SCENE]:
            self._drop(one)

    async def _process(self, export: Export) -> str | None:
        """Runs the process of an export; returns why it failed."""
        ended: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()

        def end(fault: str | None) -> None:
            if not ended.done():
                ended.set_result(fault)

        def gone(reason: ProcessExit) -> None:
            end(f"the export is gone: {reason}")

        process = self._placement.start(exporter.main, export.spec, partial(self._receive, export, end), gone)
        try:
            return await ended
        finally:
            await asyncio.shield(process.stop(1.0 if ended.done() and not ended.cancelled() else 0))

    def _receive(self, export: Export, end: Any, message: Any) -> None:
        match message:
            case ExportProgressed():
                export.done, export.size = message.done, message.size
            case Damaged():
                scene = self._scenes.by_id.get(export.scene)
                if scene is not None and scene.has_place:  # of one that sleeps the next pass over it finds them
                    scene.repair_queue.noticed(message.files)
            case ExportEnded():
                end(message.fault)

    def _drop(self, export: Export) -> None:
        """Forgets an export that is over."""
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
        """Cancels an export that waits or runs; removes one that is over, and its file.

        Raises:
            Problem: 404, there is none.
        """
        removed = self.get(scene, export)
        if removed.state in OVER:
            self._drop(removed)
            await self._clear(removed.spec.file.parent)
        else:
            await self._cancel(removed)

    async def forget(self, scene: str) -> None:
        """Ends and removes all exports of a scene that was deleted, or whose reconstruction was begun anew."""
        for export in list(self._known.get(scene, {}).values()):
            await self._cancel(export)
            self._drop(export)
        await self._clear(self._folder / scene)

    async def stop(self) -> None:
        """Ends all processes; the files go at the next start."""
        for known in list(self._known.values()):
            for export in list(known.values()):
                await self._cancel(export)
                if export.timer is not None:
                    export.timer.cancel()

    async def _cancel(self, export: Export) -> None:
        """Ends an export that waits or runs."""
        if export.task is not None and not export.task.done():
            export.task.cancel()
            await asyncio.wait({export.task})
        if export.state not in OVER:  # else it was quicker
            self._over(export, ExportState.CANCELLED, "it was cancelled")
            await self._clear(export.spec.file.parent)

    async def _clear(self, folder: Path) -> None:
        await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
