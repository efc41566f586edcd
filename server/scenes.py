"""All scenes of the service: made, found again at a start, deleted so that no power cut brings half of one back."""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from client.wire import SceneCreate
from scas4d_core.npz import sync_folder
from scas4d_core.settings import Settings
from server.definition import (
    FRAMES_FOLDER,
    JOURNAL_FILE,
    Definition,
    DefinitionError,
    is_nothing,
    read_definition,
    write_definition,
)
from server.disk import FolderLock, full_disk, no_room
from server.facts import Created
from server.hub import Hub
from server.journal import Journal
from server.placement import Placement
from server.problems import Problem, counted
from server.recovery import recover
from server.scene import Scene
from server.settings import ServerSettings

__all__ = ["Scene", "Scenes"]

log = logging.getLogger("scas4d.server")


def hold(data: Path) -> FolderLock:
    """The data folder, for this service alone; made where there is none.

    Raises:
        RuntimeError: another service is at work in it.
    """
    data.mkdir(parents=True, exist_ok=True)
    try:
        return FolderLock(data / "service.lock", wait=False)
    except BlockingIOError:
        raise RuntimeError(
            f"another service is at work in {data}; stop it, or give this one another folder: --data FOLDER"
        ) from None


class Scenes:
    """All scenes of the service, by id.

    Attributes:
        unreadable: folders of the data folder that hold no scene that can be read, with the reason; left as they are.
    """

    def __init__(self, server: ServerSettings, placement: Placement, hub: Hub) -> None:
        self.server = server
        self.placement = placement
        self.hub = hub
        self.by_id: dict[str, Scene] = {}
        self.unreadable: dict[str, str] = {}
        self._folder = (server.data / "scenes").resolve()
        self._deleted = (server.data / "deleted").resolve()
        self._lock: FolderLock | None = None
        self._making = 0

    async def open(self) -> None:
        """Finds the scenes of the data folder and takes them up again; finishes deletions that were interrupted.

        Raises:
            RuntimeError: another service is at work in the data folder.
        """
        for folder in (self._folder, self._deleted):
            folder.mkdir(parents=True, exist_ok=True)
        self._lock = hold(self.server.data)
        await asyncio.to_thread(self._clean)
        for folder in sorted(path for path in self._folder.iterdir() if path.is_dir()):
            await self._restore(folder)
        self.by_id = dict(sorted(self.by_id.items(), key=lambda item: item[1].created))

    def _clean(self) -> None:
        """Removes scenes that are deleted, and folders of scenes that were never acknowledged."""
        for path in self._folder.iterdir():
            if path.is_dir() and is_nothing(path):
                path.rename(self._deleted / f"{path.name}-{secrets.token_hex(4)}")
        sync_folder(self._folder)
        for path in self._deleted.iterdir():
            shutil.rmtree(path, ignore_errors=True)

    async def _restore(self, folder: Path) -> None:
        try:
            definition, damage = await asyncio.to_thread(read_definition, folder)
            if definition.id != folder.name:
                raise DefinitionError(f"it is of scene {definition.id}; the folder was renamed or copied")
            if damage is not None:
                await asyncio.to_thread(write_definition, folder, definition)
            found = await asyncio.to_thread(recover, folder, definition.id)
            found.damage[:0] = [damage] if damage is not None else []
            scene = Scene(definition, folder, found, self.server, self.placement, self.hub)
            scene.points_sha256 = await asyncio.to_thread(points_sha256, scene.spec.points)
        except (DefinitionError, OSError) as error:
            self.unreadable[folder.name] = str(error)
            log.error("folder %s holds no scene that can be read; it is left as it is: %s", folder, error)
            return
        for said in found.damage:
            log.warning("scene %s: %s", definition.id, said)
        self.by_id[definition.id] = scene

    async def create(self, request: SceneCreate, settings: Settings) -> Scene:
        """A new scene with its processes started; it is on disk when this returns.

        Raises:
            Problem: 429, as many scenes run as may; 507, the disk is full.
        """
        if len(self.by_id) + self._making >= self.server.max_scenes:
            raise Problem(
                429,
                f"{counted(len(self.by_id), 'scene')} of at most {self.server.max_scenes} are here already",
                field="SCAS4D_MAX_SCENES",
                value=self.server.max_scenes,
                remedy="delete a scene, or raise the limit",
                headers={"Retry-After": "60"},
            )
        definition = Definition(secrets.token_hex(6), datetime.now(UTC), request, settings)
        folder = self._folder / definition.id
        self._making += 1
        try:
            await self._write(folder, definition)
            found = await asyncio.to_thread(recover, folder, definition.id)
        except OSError as error:
            await asyncio.to_thread(shutil.rmtree, folder, ignore_errors=True)
            if no_room(error):
                raise full_disk(error) from None
            raise
        finally:
            self._making -= 1
        scene = Scene(definition, folder, found, self.server, self.placement, self.hub)
        self.by_id[definition.id] = scene
        return scene

    async def _write(self, folder: Path, definition: Definition) -> None:
        """The folder, its journal, and last the definition, which makes it a scene."""
        (folder / FRAMES_FOLDER).mkdir(parents=True)
        journal = Journal(folder / JOURNAL_FILE)
        try:
            await journal.append(Created(definition=definition.as_json()))
        finally:
            await journal.close()
        sync_folder(folder.parent)
        await asyncio.to_thread(write_definition, folder, definition)

    def __getitem__(self, id: str) -> Scene:
        scene = self.by_id.get(id)
        if scene is None:
            reason = f": {self.unreadable[id]}" if id in self.unreadable else ""
            raise Problem(
                404, f"no scene {id!r}{reason}", field="id", value=id, remedy="GET /v1/scenes lists the scenes"
            )
        return scene

    async def delete(self, id: str) -> None:
        """Ends the scene's processes and removes its folder. From the rename on it is gone, whatever happens."""
        scene = self[id]
        del self.by_id[id]
        self.hub.close(id, "the scene was deleted")
        await scene.stop()
        await asyncio.to_thread(self._remove, scene.spec.folder)

    def _remove(self, folder: Path) -> None:
        grave = self._deleted / f"{folder.name}-{secrets.token_hex(4)}"
        folder.rename(grave)
        sync_folder(self._deleted)
        sync_folder(self._folder)
        shutil.rmtree(grave, ignore_errors=True)

    async def stop(self) -> None:
        """Ends all processes; the folders stay."""
        await asyncio.gather(*(scene.stop() for scene in self.by_id.values()))
        if self._lock is not None:
            self._lock.release()


def points_sha256(path: Path) -> str | None:
    """SHA-256 of the body that a scene's points came in, or None where it has none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return bytes(file["sha256"]).hex()
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError):
        return ""
