"""Background tasks, calls that run to completion, and tasks that end together."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from functools import wraps
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


class Background:
    """Background tasks of a scene or of the service, held by strong references to prevent garbage collection.

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


def shielded(function: Callable[P, Coroutine[Any, Any, T]]) -> Callable[P, Coroutine[Any, Any, T]]:
    """Decorator of a coroutine function, which then runs to completion even if its caller is cancelled.

    A cancellation between journalling and updating the ledger would make them inconsistent.
    """

    @wraps(function)
    async def run(*args: P.args, **kwargs: P.kwargs) -> T:
        return await asyncio.shield(asyncio.ensure_future(function(*args, **kwargs)))

    return run


async def run_until_first(
    *coroutines: Coroutine[Any, Any, Any], seconds: float | None = None
) -> tuple[asyncio.Task[Any] | None, ...]:
    """Runs coroutines until one of them ends or the time limit expires, and cancels the others.

    Returns:
        For each coroutine, its task if it ended by itself, otherwise None.
    """
    tasks = tuple(asyncio.create_task(coroutine) for coroutine in coroutines)
    try:
        done, _ = await asyncio.wait(tasks, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return tuple(task if task in done else None for task in tasks)
