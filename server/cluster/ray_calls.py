"""Calls to Ray from the event loop.

Each call runs in a thread, and no call starts while the service is not a member of its cluster.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

THREADS = 8
"""Maximum number of calls that run or wait for the head node at the same time."""

T = TypeVar("T")


class RayCalls:
    """Runs blocking calls to Ray in threads. Use it only on the event loop.

    Calls can be suspended, because Ray ends the process if a call overlaps with `ray.shutdown` ("the core worker has
    already been shutdown").

    Attributes:
        running: calls that have started or are waiting for a thread.
    """

    def __init__(self) -> None:
        self.running: set[Future[Any]] = set()
        # The event loop's own thread pool writes the journals, so it must not wait for Ray.
        self._threads = ThreadPoolExecutor(THREADS, "ray")
        self._enabled = asyncio.Event()
        self._enabled.set()

    def call(self, function: Callable[..., T], *arguments: Any) -> asyncio.Task[T]:
        """Calls a function that uses Ray as soon as calls are enabled.

        If the returned task is cancelled before that, the function is never called.
        """
        return asyncio.get_running_loop().create_task(self._run(function, *arguments))

    async def _run(self, function: Callable[..., T], *arguments: Any) -> T:
        while True:
            await self._enabled.wait()
            call = self._threads.submit(function, *arguments)
            self.running.add(call)
            call.add_done_callback(self.running.discard)
            try:
                return await asyncio.wrap_future(call)
            except asyncio.CancelledError:
                task = asyncio.current_task()
                if task is None or task.cancelling():
                    raise  # otherwise, `suspend` was called before a thread was free

    def suspend(self) -> None:
        """Suspends calls; new calls and those that are waiting for a thread start after `resume`."""
        self._enabled.clear()
        for call in tuple(self.running):
            call.cancel()

    def resume(self) -> None:
        """Allows calls to start again."""
        self._enabled.set()

    async def wait(self, seconds: float) -> bool:
        """Waits up to `seconds` for the running calls to finish and returns whether all have."""
        return not (await asyncio.to_thread(wait, tuple(self.running), seconds)).not_done

    def close(self) -> None:
        """Prevents any further call from starting; running calls continue."""
        self._threads.shutdown(wait=False, cancel_futures=True)
