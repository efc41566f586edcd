"""All scenes of the service: creates, recovers, begins again and deletes them; no power cut leaves half a scene."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import shutil
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NoReturn

from client.wire import SceneCreate
from scas4d_core.errors import message_of
from scas4d_core.rig_checks import rig_warnings
from scas4d_core.settings import Settings
from scas4d_core.storage.npz import sync_folder
from server.problems import Problem, counted
from server.processes.placement import Placement
from server.scene.beginning import Beginning
from server.scene.scene import Scene
from server.settings import ServerSettings
from server.storage.definition import (
    Definition,
    DefinitionError,
    never_acknowledged,
    read_definition,
    write_definition,
)
from server.storage.disk import FolderLock, full_disk, no_room
from server.storage.events import SceneCreated
from server.storage.journal import Journal
from server.storage.layout import DataFolder, SceneFolder
from server.storage.points import points_positions, points_sha256
from server.storage.recovery import Recovered, recover
from server.stream.hub import Hub

__all__ = ["Scene", "Scenes"]

log = logging.getLogger("scas4d.server")


def lock_data(data: Path) -> FolderLock:
    """Locks the data folder for this service; the folder is made when missing.

    Raises:
        RuntimeError: another service is at work in it.
    """
    data.mkdir(parents=True, exist_ok=True)
    try:
        return FolderLock(DataFolder(data).lock, wait=False)
    except BlockingIOError:
        raise RuntimeError(
            f"another service is at work in {data}; stop it, or give this one another folder: --data FOLDER"
        ) from None


class Scenes:
    """All scenes of the service, by id.

    Attributes:
        unreadable: folders whose scene cannot be read, with the reason; they are left as they are.
    """

    def __init__(self, server: ServerSettings, placement: Placement, hub: Hub) -> None:
        self.server = server
        self.placement = placement
        self.hub = hub
        self.by_id: dict[str, Scene] = {}
        self.unreadable: dict[str, str] = {}
        self._data = DataFolder(server.data.resolve())
        self._lock: FolderLock | None = None
        self._making = 0
        self._found: list[str] = []
        """Folders found at the start; those in `by_id` or `unreadable` are recovered."""
        self._recovering: asyncio.Task[None] | None = None
        self._beginning: dict[str, asyncio.Task[None]] = {}
        """Scenes whose reconstruction is being begun anew."""
        self._sweeping: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Finds the scenes of the data folder; recovers them in the background, as a journal may be that of a day.

        Raises:
            RuntimeError: another service is at work in the data folder.
        """
        for folder in (self._data.scenes, self._data.deleted):
            folder.mkdir(parents=True, exist_ok=True)
        self._lock = lock_data(self.server.data)
        self._found = await asyncio.to_thread(self._folders)
        self._recovering = asyncio.create_task(self._recover())

    def _folders(self) -> list[str]:
        """Lists the folders of scenes; moves those that were never acknowledged to the deleted ones."""
        found = []
        for path in sorted(path for path in self._data.scenes.iterdir() if path.is_dir()):
            if never_acknowledged(SceneFolder(path)):
                path.rename(self._data.deleted / f"{path.name}-{secrets.token_hex(4)}")
            else:
                found.append(path.name)
        sync_folder(self._data.scenes)
        return found

    async def _recover(self) -> None:
        """Recovers the scenes that were found, one after the other, and finishes interrupted deletions."""
        for name in self._found:
            try:
                await self._restore(self._data.scene(name))
            except Exception as error:  # a fault of one scene is no fault of the others
                self.unreadable[name] = f"the service failed: {type(error).__name__}: {message_of(error)}"
                log.exception("scene %s cannot be recovered", name)
        await asyncio.to_thread(self._sweep)

    def _sweep(self) -> None:
        """Removes what was moved to the deleted ones."""
        for path in self._data.deleted.iterdir():
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                with contextlib.suppress(OSError):
                    path.unlink()

    def check_recovered(self, id: str | None = None) -> None:
        """Checks that the scenes found at the start, or one of them, are recovered.

        Raises:
            Problem: 503, with the number of those that are.
        """
        missing = [name for name in self._found if name not in self.by_id and name not in self.unreadable]
        if id not in missing and (id is not None or not missing):
            return
        raise Problem(
            503,
            f"recovering {len(self._found) - len(missing)} of {counted(len(self._found), 'scene')}",
            field="id" if id is not None else None,
            value=id,
            remedy="ask again: all acknowledged frames are on disk, and are being read",
            headers={"Retry-After": "1"},
            recovering=missing,
        )

    async def _restore(self, folder: SceneFolder, said: Sequence[str] = ()) -> None:
        """Recovers a scene from its folder; `said`: of damage found before."""
        try:
            definition, damage = await asyncio.to_thread(read_definition, folder)
            if definition.id != folder.name:
                raise DefinitionError(f"it is of scene {definition.id}; the folder was renamed or copied")
            if damage is not None:
                await asyncio.to_thread(write_definition, folder, definition)
            found = await asyncio.to_thread(recover, folder, definition.id, definition.as_json())
            before = [*said, damage] if damage is not None else said
            found.damage[:0] = [sentence for sentence in dict.fromkeys(before) if sentence not in found.damage]
            folder, definition = found.folder, await self._begun(found, definition)
            scene = Scene(definition, folder, found, self.server, self.placement, self.hub)
            scene.points_sha256 = await asyncio.to_thread(points_sha256, folder.points)
            if (positions := await asyncio.to_thread(points_positions, folder.points)) is not None:
                scene.warnings = rig_warnings(scene.rig, scene.spec.settings.scene, positions)
            await scene.updates.recall()
        except (DefinitionError, OSError) as error:
            self.unreadable[folder.name] = message_of(error)
            log.error("folder %s holds no scene that can be read; it is left as it is: %s", folder.path, error)
            return
        for sentence in found.damage:
            log.warning("scene %s: %s", definition.id, sentence)
        self.by_id = dict(sorted([*self.by_id.items(), (scene.id, scene)], key=lambda item: item[1].created))

    async def _begun(self, found: Recovered, definition: Definition) -> Definition:
        """Follows the reconstruction that was begun last: the definition, and the folder without what was before it."""
        folder, event = found.folder, found.ledger.begun
        if (now := definition.after(event)) is not definition:
            try:
                await asyncio.to_thread(write_definition, folder, now)
            except OSError as error:  # the journal has it, and the next start writes it
                if not no_room(error):
                    raise
        for path in await asyncio.to_thread(folder.leftovers, event):
            await asyncio.to_thread(self._bury, path, f"{folder.name}-{path.name}")
        return now

    def check_current(self, scene: Scene) -> None:
        """Refuses what was meant for a scene as it was before its reconstruction was begun anew.

        Raises:
            Problem: 503, to send it again.
        """
        if self[scene.id] is not scene:
            fault = "the reconstruction of this scene was begun anew while this request came"
            raise Problem(503, fault, field="id", value=scene.id, remedy="send the request again")

    async def begin_again(self, scene: Scene, beginning: Beginning) -> Scene:
        """Begins the reconstruction of a scene anew; the same request again returns the scene as it is.

        The scene is stopped, the event journalled, and the scene recovered from its folder, as after a crash; until
        then it answers 503. A refusal leaves it as it was.

        Raises:
            Problem: see `Beginning.event`; 507, the disk is full.
        """
        id, current = scene.id, self[scene.id]
        if beginning.event(current.ledger, current.spec.folder) is None:
            return current
        self.check_current(scene)
        self._beginning[id] = task = asyncio.create_task(self._begin_again(scene, beginning))
        task.add_done_callback(lambda _: self._beginning.pop(id))
        await asyncio.shield(task)
        return self.by_id.get(id) or self.refuse(id)

    async def _begin_again(self, scene: Scene, beginning: Beginning) -> None:
        self.hub.restart(scene.id)
        async with scene.log.lock:  # points that are being written are whole, and later ones are refused
            pass
        await scene.stop(0)
        folder, said = self._data.scene(scene.id), scene.status().damage
        try:
            said += await self._journal_beginning(folder, beginning)
        finally:
            await self._restore(folder, said)
            if self.by_id.get(scene.id) is scene:  # it cannot be read
                del self.by_id[scene.id]
        self._sweeping = asyncio.create_task(asyncio.to_thread(self._sweep))

    async def _journal_beginning(self, folder: SceneFolder, beginning: Beginning) -> list[str]:
        """Journals the beginning of a scene that is stopped, if it still may: a frame may have been committed since.

        Returns:
            Sentences about damage that was found.
        """
        definition, _ = await asyncio.to_thread(read_definition, folder)
        found = await asyncio.to_thread(recover, folder, definition.id, definition.as_json())
        event = beginning.event(found.ledger, found.folder)
        assert event is not None
        journal = Journal(folder.journal, found.good)
        try:
            await journal.append(*found.events, event)
        except OSError as error:
            if no_room(error):
                raise full_disk(error) from None
            raise
        finally:
            await journal.close()
        log.warning("scene %s begins reconstruction %d with frame %d", folder.name, event.number, event.index)
        return found.damage

    async def create(self, request: SceneCreate, settings: Settings) -> Scene:
        """Creates a scene and starts its processes; the scene is on disk when this returns.

        Raises:
            Problem: 429, as many scenes run as may; 503, those found at the start are still being recovered; 507, the
                disk is full.
        """
        self.check_recovered()  # they count
        if len(self.by_id) + self._making >= self.server.max_scenes:
            raise Problem(
                429,
                f"{counted(len(self.by_id), 'scene')} of at most {self.server.max_scenes} are here already",
                field="SCAS4D_MAX_SCENES",
                value=self.server.max_scenes,
                remedy="delete a scene (DELETE /v1/scenes/ID), or raise SCAS4D_MAX_SCENES",
                headers={"Retry-After": "60"},
            )
        definition = Definition(secrets.token_hex(6), datetime.now(UTC), request, settings)
        folder = self._data.scene(definition.id)
        self._making += 1
        try:
            await self._write(folder, definition)
            found = await asyncio.to_thread(recover, folder, definition.id)
        except OSError as error:
            await asyncio.to_thread(shutil.rmtree, folder.path, ignore_errors=True)
            if no_room(error):
                raise full_disk(error) from None
            raise
        finally:
            self._making -= 1
        scene = Scene(definition, folder, found, self.server, self.placement, self.hub)
        self.by_id[definition.id] = scene
        return scene

    async def _write(self, folder: SceneFolder, definition: Definition) -> None:
        """Writes the folder, its journal, and last the definition, which makes it a scene."""
        folder.frames.mkdir(parents=True)
        journal = Journal(folder.journal)
        try:
            await journal.append(SceneCreated(definition=definition.as_json()))
        finally:
            await journal.close()
        sync_folder(folder.path.parent)
        await asyncio.to_thread(write_definition, folder, definition)

    def __getitem__(self, id: str) -> Scene:
        """Returns a scene.

        Raises:
            Problem: see `refuse`; 503, its reconstruction is being begun anew.
        """
        if id in self._beginning:
            raise Problem(
                503,
                "the reconstruction of this scene is being begun anew",
                field="id",
                value=id,
                remedy="ask again",
                headers={"Retry-After": "1"},
            )
        if id not in self.by_id:
            self.refuse(id)
        return self.by_id[id]

    def refuse(self, id: str) -> NoReturn:
        """Says why there is no such scene.

        Raises:
            Problem: 404, or 503 while scenes are still recovered.
        """
        self.check_recovered(id)
        reason = f": {self.unreadable[id]}" if id in self.unreadable else ""
        raise Problem(404, f"no scene {id!r}{reason}", field="id", value=id, remedy="GET /v1/scenes lists the scenes")

    async def delete(self, id: str) -> None:
        """Ends the scene's processes and removes its folder. The scene is gone once the folder is renamed."""
        scene = self[id]
        self._found = [name for name in self._found if name != id]
        del self.by_id[id]
        self.hub.close(id, "the scene was deleted")
        await scene.stop()
        await asyncio.to_thread(self._remove, scene.spec.folder.path)

    def _remove(self, folder: Path) -> None:
        shutil.rmtree(self._bury(folder, folder.name), ignore_errors=True)

    def _bury(self, path: Path, name: str) -> Path:
        """Moves a file or a folder to the deleted ones; returns its new path."""
        grave = self._data.deleted / f"{name}-{secrets.token_hex(4)}"
        path.rename(grave)
        sync_folder(self._data.deleted)
        sync_folder(path.parent)
        return grave

    async def stop(self) -> None:
        """Ends all processes; the folders stay."""
        if self._recovering is not None:
            self._recovering.cancel()
            await asyncio.wait([self._recovering])
        if self._beginning:
            await asyncio.wait(self._beginning.values())
        await asyncio.gather(*(scene.stop() for scene in self.by_id.values()))
        if self._lock is not None:
            self._lock.release()
