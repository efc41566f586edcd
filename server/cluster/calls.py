"""Calls of Ray from the event loop: each waits for the cluster in a thread, and none while the service has left it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

THREADS = 8
"""That wait for the head of the cluster at a time."""

T = TypeVar("T")


class Calls:
    """On the event loop.

    Ray ends the process where a call of it meets `ray.shutdown` ("the core worker has already been shutdown").
    """

    def __init__(self) -> None:
        # Of its own: the journals are written by those of the event loop, and the head of the cluster may not answer.
        self._threads = ThreadPoolExecutor(THREADS, "ray")
        self._may_begin = asyncio.Event()
        self._may_begin.set()
        self._begun: set[Future[Any]] = set()

    def asked(self, function: Callable[..., T], *arguments: Any) -> asyncio.Task[T]:
        """Calls a function that asks Ray; once it may begin. One that is cancelled before has not been called."""
        return asyncio.get_running_loop().create_task(self._call(function, *arguments))

    async def _call(self, function: Callable[..., T], *arguments: Any) -> T:
        await self._may_begin.wait()
        call = self._threads.submit(function, *arguments)
        self._begun.add(call)
        call.add_done_callback(self._begun.discard)
        return await asyncio.wrap_future(call)

    def hold(self) -> None:
        """Lets no call begin from now on."""
        self._may_begin.clear()

    def go_on(self) -> None:
        """Lets them begin again."""
        self._may_begin.set()

    async def over(self, seconds: float) -> bool:
        """Waits for those that have begun, for so long; returns whether all are over."""
        begun = [asyncio.ensure_future(asyncio.wrap_future(call)) for call in tuple(self._begun)]
        if not begun:
            return True
        _, left = await asyncio.wait(begun, timeout=seconds)
        return not left

    def close(self) -> None:
        """Lets no call begin any more; one that is on goes on."""
        self._threads.shutdown(wait=False, cancel_futures=True)
