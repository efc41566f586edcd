"""Registry of all scenes, which creates, wakes, restarts and deletes them.

Creation, restart and deletion each take effect in a single step on disk. A power failure therefore
never leaves a scene in an intermediate state.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import shutil
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from datetime import UTC, datetime
from typing import NoReturn

from client.wire import SceneCreate, SceneStatus
from scas4d_core.errors import message_of
from scas4d_core.settings import Settings
from server.background import Background
from server.hub import Hub
from server.problems import Problem
from server.processes.placement import Placement
from server.scene import sleep
from server.scene.new_reconstruction import NewReconstruction, journal_new_reconstruction, restarting_problem
from server.scene.scene import Scene
from server.scene.sleep import SleepingScene, Transitions
from server.scene.startup_recovery import StartupRecovery
from server.scene.status_cache import write_status_cache
from server.scene.stored_scene import create_folder, read_stored_scene
from server.settings import ServerSettings
from server.storage.definition import Definition, DefinitionError
from server.storage.disk import FolderLock, full_disk, lock_data, no_room
from server.storage.layout import DataFolder, SceneFolder

log = logging.getLogger("scas4d.server")


class Scenes:
    """Registry of all scenes of the service.

    Attributes:
        awake: scenes in memory, with or without a slot for processes, keyed by ID.
        asleep: all other recovered scenes, keyed by ID.
        recovering: recovery of the scenes found at startup.
        unreadable: reason for each scene folder that cannot be read, keyed by scene ID; the folders are left unchanged.
    """

    def __init__(self, server: ServerSettings, placement: Placement, hub: Hub) -> None:
        self.server = server
        self.placement = placement
        self.hub = hub
        self.awake: dict[str, Scene] = {}
        self.asleep: dict[str, SleepingScene] = {}
        self.unreadable: dict[str, str] = {}
        self._data = DataFolder(server.data.resolve())
        self.recovering = StartupRecovery(self._data, self._register_stored)
        self._lock: FolderLock | None = None
        self._promised = 0
        """Number of slots reserved for scenes that are not in `awake` yet."""
        self._beginning: dict[str, asyncio.Task[None]] = {}
        """Tasks of scenes whose reconstruction is being restarted, keyed by scene ID."""
        self._turns = Transitions()
        self._background = Background(lambda error: log.error("a task of the service failed", exc_info=error))

    async def open(self) -> None:
        """Locks the data folder, finds its scenes and starts to recover them.

        The recovery runs in the background, because a journal may contain the events of a whole
        day.

        Raises:
            RuntimeError: another service is using the data folder.
        """
        for folder in (self._data.scenes, self._data.deleted):
            folder.mkdir(parents=True, exist_ok=True)
        self._lock = lock_data(self.server.data)
        await self.recovering.begin()
        self._background.run(self._put_idle_to_sleep())

    # Awake and sleeping scenes.

    def __len__(self) -> int:
        """Returns the number of scenes, awake or asleep."""
        return len(self.awake.keys() | self.asleep.keys())

    def __contains__(self, id: str) -> bool:
        return any(id in known for known in (self.awake, self.asleep, self.unreadable, self.recovering))

    def statuses(self) -> list[SceneStatus]:
        """Returns the status of every recovered scene, oldest first, without waking any."""
        entries = [(scene.created, scene.status) for id, scene in self.asleep.items() if id not in self.awake]
        entries += [(scene.created, scene.status()) for scene in self.awake.values()]
        return [status for _, status in sorted(entries, key=lambda one: one[0])]

    def status(self, id: str) -> SceneStatus:
        """Returns the status of a scene without waking it.

        Raises:
            Problem: see `refuse`.
        """
        if id not in self.awake and id not in self._beginning and id in self.asleep:
            return self.asleep[id].status
        return self[id].status()

    @asynccontextmanager
    async def use(self, id: str, *, place: bool = True) -> AsyncIterator[Scene]:
        """Yields a scene for a request or a connection. The scene is woken if it is asleep.

        Inside the context, the scene does not fall asleep.

        Args:
            id: scene ID.
            place: whether the scene gets a slot for processes; requests that need no processes pass False.

        Raises:
            Problem: see `refuse`; 429 if the scene needs a slot and none can be freed.
        """
        scene = await self._awake(id, place)
        scene.users += 1
        try:
            yield scene
        finally:
            scene.users -= 1
            scene.used = time.monotonic()

    async def _awake(self, id: str, place: bool) -> Scene:
        while True:
            if id in self._turns:
                await self._turns.end(id)
            elif id in self.asleep and id not in self.awake and id not in self._beginning:
                self._turns.begin(id, self._wake(id))
            elif (scene := self[id]).has_place or not place:
                return scene
            else:
                await self._reserve_place()
                self._promised -= 1
                if self.awake.get(id) is scene and id not in self._turns:
                    scene.has_place = True

    @property
    def _free_places(self) -> int:
        return self.server.max_scenes - sum(scene.has_place for scene in self.awake.values()) - self._promised

    async def _reserve_place(self) -> None:
        """Reserves a slot for a scene, putting an idle scene to sleep if no slot is free.

        Raises:
            Problem: 429 if no slot is free and no scene is idle.
        """
        while self._free_places <= 0:
            if falling := [id for id in self._turns if id in self.awake]:
                await self._turns.end(falling[0])
            else:
                await self.put_to_sleep(sleep.scene_to_put_to_sleep(self.awake.values(), self.server))
        self._promised += 1

    async def put_to_sleep(self, scene: Scene) -> None:
        """Stops a scene's processes and releases its slot, if the scene is still idle.

        No data is lost, because all data of a scene is in its folder.
        """
        if self.awake.get(scene.id) is scene and scene.id not in self._turns and scene.idle:
            self._turns.begin(scene.id, self._fall_asleep(scene))
        await self._turns.end(scene.id)

    async def _fall_asleep(self, scene: Scene) -> None:
        self._note_asleep(status := scene.status().model_copy(update={"asleep": True}))
        try:
            await scene.stop()
            await asyncio.to_thread(write_status_cache, scene.spec.folder, status)
        except Exception:  # harmless: all data of the scene is in its folder
            log.exception("scene %s did not stop cleanly", scene.id)
        del self.awake[scene.id]
        log.info("scene %s fell asleep", scene.id)

    def _note_asleep(self, status: SceneStatus) -> None:
        self.asleep[status.id] = SleepingScene(status.id, datetime.fromisoformat(status.created), status)

    async def _wake(self, id: str) -> None:
        if not await self._register_stored(self._data.scene(id), self.asleep[id].status.damage, wake=True):
            raise sleep.cannot_wake_problem(id, self.unreadable.pop(id))
        del self.asleep[id]

    async def _put_idle_to_sleep(self) -> None:
        """Periodically puts to sleep the scenes that have been idle long enough."""
        while (seconds := sleep.check_interval(self.server)) is not None:
            await asyncio.sleep(seconds)
            for scene in sleep.idle_scenes(tuple(self.awake.values()), self.server):
                try:
                    await self.put_to_sleep(scene)
                except Exception:  # a failure must not keep other scenes awake
                    log.exception("scene %s could not be put to sleep", scene.id)

    async def _register_stored(self, folder: SceneFolder, said: Sequence[str] = (), *, wake: bool = False) -> bool:
        """Registers a stored scene as awake or asleep.

        A scene with pending work always gets a slot, even beyond the limit. At startup, a recently
        used scene gets a slot if one is free.

        Args:
            folder: scene folder.
            said: messages about damage that was found earlier.
            wake: whether to load the scene into memory even if it would be asleep.

        Returns:
            False if the scene cannot be read, otherwise True. In the first case, the reason is
            stored in `unreadable`.
        """
        try:
            if (
                not wake
                and (status := await asyncio.to_thread(sleep.status_if_still_asleep, folder, self.server)) is not None
            ):
                self._note_asleep(status)
                return True
            restored = await asyncio.to_thread(read_stored_scene, folder, self._data.move_to_deleted, said)
            goes_on = not wake and sleep.was_awake(restored.used, self.server) and self._free_places > 0
            if restored.has_work or goes_on or wake:
                scene = Scene(restored, self.server, self.placement, self.hub)
                scene.has_place = restored.has_work or goes_on
                self.awake[scene.id] = scene
                if goes_on:
                    scene.start()
                scene.updates.begin()
            else:
                self._note_asleep(status := restored.facts(self.server.queue_frames).status())
                await asyncio.to_thread(write_status_cache, folder, status)
        except Exception as error:  # a faulty scene must not affect the others
            known = isinstance(error, DefinitionError | OSError)
            reason = message_of(error) if known else f"internal error: {type(error).__name__}: {message_of(error)}"
            self.unreadable[folder.name] = reason
            log.error("folder %s cannot be read: %s", folder.path, reason, exc_info=None if known else error)
            return False
        for sentence in restored.content.damage:
            if sentence not in said:
                log.warning("scene %s: %s", folder.name, sentence)
        return True

    # Restart of reconstructions.

    def check_current(self, scene: Scene) -> None:
        """Refuses a request that arrived before the scene's reconstruction was restarted.

        Raises:
            Problem: 503 if the request must be sent again.
        """
        if self[scene.id] is not scene:
            fault = "the reconstruction of this scene was restarted while the request was being received"
            raise Problem(503, fault, field="id", value=scene.id, remedy="send the request again")

    async def begin_again(self, scene: Scene, beginning: NewReconstruction) -> SceneStatus:
        """Restarts the reconstruction of a scene and returns its status; a repeated request has no effect.

        The scene is stopped, the event is journalled, and the scene is recovered from its folder as after a crash.
        Requests get 503 in the meantime. If the restart is refused, the scene is unchanged.

        Raises:
            Problem: see `NewReconstruction.event`; 503 if another restart has begun in the
                meantime; 507 if the disk is full.
        """
        id, current = scene.id, self[scene.id]
        if beginning.event(current.ledger, current.spec.folder) is None:
            return current.status()
        self.check_current(scene)
        self._beginning[id] = task = asyncio.create_task(self._begin_again(scene, beginning))
        task.add_done_callback(lambda _: self._beginning.pop(id))
        await asyncio.shield(task)
        return self.status(id)

    async def _begin_again(self, scene: Scene, beginning: NewReconstruction) -> None:
        self.hub.restart(scene.id)
        async with scene.log.lock:  # lets a pending write of points complete; later ones are refused
            pass
        await scene.stop(0)
        folder, said = self._data.scene(scene.id), scene.status().damage
        try:
            said += await journal_new_reconstruction(folder, beginning)
        finally:
            if await self._register_stored(folder, said, wake=True):
                self.awake[scene.id].has_place = True
                self.awake[scene.id].start()
            else:
                del self.awake[scene.id]
        self._background.run(asyncio.to_thread(self._data.remove_deleted))

    # Creation and deletion.

    async def create(self, request: SceneCreate, settings: Settings) -> Scene:
        """Creates a scene on disk and starts its processes.

        Raises:
            Problem: 429 if all slots are in use; 503 if the scenes found at startup are still being recovered; 507 if
                the disk is full.
        """
        self.recovering.check()  # scenes that are being recovered may need slots
        await self._reserve_place()
        definition = Definition(secrets.token_hex(6), datetime.now(UTC), request, settings)
        folder = self._data.scene(definition.id)
        try:
            created = await create_folder(folder, definition)
        except OSError as error:
            await asyncio.to_thread(shutil.rmtree, folder.path, ignore_errors=True)
            if no_room(error):
                raise full_disk(error) from None
            raise
        finally:
            self._promised -= 1
        scene = Scene(created, self.server, self.placement, self.hub)
        scene.has_place = True
        self.awake[definition.id] = scene
        scene.start()
        return scene

    def __getitem__(self, id: str) -> Scene:
        """Returns an awake scene.

        Raises:
            Problem: see `refuse`; 503 if its reconstruction is being restarted.
        """
        if id in self._beginning:
            raise restarting_problem(id)
        if id not in self.awake:
            self.refuse(id)
        return self.awake[id]

    def refuse(self, id: str) -> NoReturn:
        """Raises the `Problem` for a scene that does not exist or is not available yet.

        Raises:
            Problem: 503 if the scene is still being recovered, otherwise 404.
        """
        self.recovering.check(id)
        reason = f": {self.unreadable[id]}" if id in self.unreadable else ""
        raise Problem(
            404, f"no scene {id!r}{reason}", field="id", value=id, remedy="list all scenes with GET /v1/scenes"
        )

    async def delete(self, id: str) -> None:
        """Stops a scene's processes and removes its folder.

        The deletion takes effect when the folder is renamed.

        Raises:
            Problem: see `refuse`.
        """
        while id in self._turns:  # another task waiting for the same transition may start a new one
            with suppress(Problem):  # a scene that cannot be woken can still be deleted
                await self._turns.end(id)
        folder = self._data.scene(id).path
        if id in self.asleep and id not in self._beginning:
            del self.asleep[id]
        else:
            scene = self[id]
            del self.awake[id]
            self.hub.close(id, "the scene was deleted")
            await scene.stop()
        grave = await asyncio.to_thread(self._data.move_to_deleted, folder, folder.name)
        await asyncio.to_thread(shutil.rmtree, grave, ignore_errors=True)

    async def stop(self) -> None:
        """Stops all scenes and their processes, and keeps their folders."""
        await self.recovering.stop()
        await asyncio.gather(*self._turns.values(), return_exceptions=True)
        if self._beginning:
            await asyncio.wait(self._beginning.values())
        self._background.cancel()
        await asyncio.gather(*(scene.stop() for scene in self.awake.values()))
        if self._lock is not None:
            self._lock.release()
