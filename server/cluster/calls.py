"""Calls of Ray from the event loop. Each runs in a thread; none begins while the service has left its cluster."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

THREADS = 8
"""That wait for the head of the cluster at a time."""

T = TypeVar("T")


class Calls:
    """On the event loop.

    Ray ends the process where a call of it meets `ray.shutdown` ("the core worker has already been shutdown").

    Attributes:
        begun: calls that have begun, or wait for a thread.
    """

    def __init__(self) -> None:
        self.begun: set[Future[Any]] = set()
        # Of its own: the journals are written by those of the event loop, and the head of the cluster may not answer.
        self._threads = ThreadPoolExecutor(THREADS, "ray")
        self._may_begin = asyncio.Event()
        self._may_begin.set()

    def asked(self, function: Callable[..., T], *arguments: Any) -> asyncio.Task[T]:
        """Calls a function that asks Ray, once calls may begin. One that is cancelled before is never called."""
        return asyncio.get_running_loop().create_task(self._call(function, *arguments))

    async def _call(self, function: Callable[..., T], *arguments: Any) -> T:
        while True:
            await self._may_begin.wait()
            call = self._threads.submit(function, *arguments)
            self.begun.add(call)
            call.add_done_callback(self.begun.discard)
            try:
                return await asyncio.wrap_future(call)
            except asyncio.CancelledError:
                task = asyncio.current_task()
                if task is None or task.cancelling():
                    raise  # else `hold` came before a thread was free

    def hold(self) -> None:
        """Lets no call begin from now on; those that wait for a thread begin later."""
        self._may_begin.clear()
        for call in tuple(self.begun):
            call.cancel()

    def go_on(self) -> None:
        """Lets them begin again."""
        self._may_begin.set()

    async def over(self, seconds: float) -> bool:
        """Waits for those that have begun, for so long; returns whether all are over."""
        return not (await asyncio.to_thread(wait, tuple(self.begun), seconds)).not_done

    def close(self) -> None:
        """Lets no call begin any more; one that is on goes on."""
        self._threads.shutdown(wait=False, cancel_futures=True)
