"""Recovery at startup: finds the scenes in the data folder and loads them in the background."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Awaitable, Callable

from scas4d_core.storage.npz import sync_folder
from server.problems import Problem, count_noun
from server.storage.definition import never_acknowledged
from server.storage.layout import DataFolder, SceneFolder


class StartupRecovery:
    """Recovery of the scenes that were found at startup.

    Args:
        data: the service's data folder.
        read: function that loads a scene from its folder; must not raise.
    """

    def __init__(self, data: DataFolder, read: Callable[[SceneFolder], Awaitable[object]]) -> None:
        self._data = data
        self._read = read
        self._count = 0
        self._left: list[str] = []
        self._task: asyncio.Task[None] | None = None

    def __contains__(self, id: str) -> bool:
        """Returns whether a scene was found but is not recovered yet."""
        return id in self._left

    async def begin(self) -> None:
        """Lists the scenes and starts to load them in the background.

        Loading may take long, because a journal may contain the events of a whole day.
        """
        self._left = await asyncio.to_thread(self._folders)
        self._count = len(self._left)
        self._task = asyncio.create_task(self._run())

    async def stop(self) -> None:
        """Cancels the recovery."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])

    def check(self, id: str | None = None) -> None:
        """Checks that one scene, or every scene if `id` is None, has been recovered.

        Raises:
            Problem: 503 with the number of scenes recovered so far.
        """
        if id not in self._left and (id is not None or not self._left):
            return
        raise Problem(
            503,
            f"recovered {self._count - len(self._left)} of {count_noun(self._count, 'scene')} so far",
            field="id" if id is not None else None,
            value=id,
            remedy="try again later; all acknowledged frames are on disk and are being loaded",
            headers={"Retry-After": "1"},
            recovering=list(self._left),
        )

    async def _run(self) -> None:
        while self._left:
            await self._read(self._data.scene(self._left[0]))
            del self._left[0]
        await asyncio.to_thread(self._data.remove_deleted)

    def _folders(self) -> list[str]:
        """Returns the names of the scene folders, those with the newest journals first.

        Folders of scenes whose creation was never acknowledged are moved to the `deleted` folder.
        """
        folders = []
        for path in sorted(path for path in self._data.scenes.iterdir() if path.is_dir()):
            folder = SceneFolder(path)
            if never_acknowledged(folder):
                path.rename(self._data.deleted / f"{path.name}-{secrets.token_hex(4)}")
            else:
                folders.append((folder.journal.stat().st_mtime if folder.journal.exists() else 0.0, path.name))
        sync_folder(self._data.scenes)
        return [name for _, name in sorted(folders, reverse=True)]
