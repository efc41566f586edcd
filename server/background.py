"""Background tasks of a scene: kept until they are done, and cancelled when the scene ends."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any


class Background:
    """Keeps the background tasks of a scene until they are done; the scene's end cancels them.

    Args:
        failed: called with the error that a task ended with.
    """

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        self._failed = failed
        self._tasks: set[asyncio.Task[None]] = set()
        self._endless: set[asyncio.Task[None]] = set()

    @property
    def busy(self) -> bool:
        """True while a task is not done that ends by itself."""
        return bool(self._tasks - self._endless)

    def run(self, coroutine: Coroutine[Any, Any, None], *, endless: bool = False) -> None:
        """Begins a task; tasks run in the order of the calls where they do not wait."""
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        if endless:
            self._endless.add(task)
        task.add_done_callback(self._done)

    def _done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        self._endless.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._failed(error)

    def cancel(self) -> None:
        """Cancels all tasks."""
        for task in tuple(self._tasks):
            task.cancel()
