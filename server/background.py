"""A scene's background tasks, kept alive until they finish and cancelled when the scene is closed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any


class Background:
    """A scene's background tasks, held by strong references to prevent garbage collection.

    Args:
        failed: callback for exceptions raised by tasks.
    """

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        self._failed = failed
        self._tasks: set[asyncio.Task[None]] = set()
        self._endless: set[asyncio.Task[None]] = set()

    @property
    def busy(self) -> bool:
        """True while any task other than an endless one is running."""
        return bool(self._tasks - self._endless)

    def run(self, coroutine: Coroutine[Any, Any, None], *, endless: bool = False) -> None:
        """Starts a task; tasks start in the order of the calls.

        Args:
            coroutine: coroutine to run.
            endless: whether the task runs until it is cancelled; such a task does not count as `busy`.
        """
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
