"""Processes on this machine, spawned (never forked: the service has threads, Numba and CUDA do not survive a fork)."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import queue
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from server.processes.messages import Stop
from server.processes.placement import Ended, Entry

_context = multiprocessing.get_context("spawn")


class LocalProcess:
    """A spawned process. Two threads move its messages, so that the event loop never waits on a pipe."""

    def __init__(
        self,
        entry: Entry,
        spec: Any,
        on_message: Callable[[Any], None],
        on_end: Callable[[Ended], None],
        prepare: Callable[[], None] | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._on_message = on_message
        self._on_end = on_end
        self._stopping = False
        self._reaping = threading.Lock()  # two threads that wait for one process confuse multiprocessing
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._connection, theirs = _context.Pipe()
        self._process = _context.Process(target=_run, args=(prepare, entry, spec, theirs), daemon=True)
        # Starting takes some 20 ms and blocks; it is done on the event loop, once a scene.
        self._process.start()
        theirs.close()
        self._threads = [
            threading.Thread(target=self._write, args=(self._connection,), daemon=True),
            threading.Thread(target=self._read, args=(self._connection,), daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def pid(self) -> int | None:
        """Of the operating system."""
        return self._process.pid

    def send(self, message: Any) -> None:
        """Posts a message."""
        self._outbox.put(message)

    async def stop(self, seconds: float) -> None:
        """Asks it to end, waits, then ends it."""
        self._stopping = True
        self.send(Stop())
        await asyncio.to_thread(self._join, seconds)

    def _join(self, seconds: float) -> None:
        with self._reaping:
            self._process.join(seconds)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()
        self._outbox.put(None)
        for thread in self._threads:
            thread.join()
        self._connection.close()
        self._process.close()

    def _write(self, connection: Connection[Any, Any]) -> None:
        while (message := self._outbox.get()) is not None:
            with contextlib.suppress(OSError):  # it has ended: the reading thread says so
                connection.send(message)

    def _read(self, connection: Connection[Any, Any]) -> None:
        while True:
            try:
                message = connection.recv()
            except (EOFError, OSError):
                break
            self._call(self._on_message, message)
        if self._stopping:
            return
        with self._reaping:
            self._process.join()
            code = self._process.exitcode
        self._outbox.put(None)  # nobody may ever call stop: the other thread ends with the process
        self._call(self._on_end, Ended(code))

    def _call(self, function: Callable[[Any], None], argument: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop has closed
            self._loop.call_soon_threadsafe(function, argument)


def _run(prepare: Callable[[], None] | None, entry: Entry, spec: Any, connection: Connection[Any, Any]) -> None:
    if prepare is not None:
        prepare()
    entry(spec, connection)


class LocalPlacement:
    """Runs every scene on this machine.

    Args:
        prepare: called first thing in every process, as to set up its logs; has to pickle.
    """

    def __init__(self, prepare: Callable[[], None] | None = None) -> None:
        self.prepare = prepare

    def start(
        self, entry: Entry, spec: Any, on_message: Callable[[Any], None], on_end: Callable[[Ended], None]
    ) -> LocalProcess:
        """Spawns the process."""
        return LocalProcess(entry, spec, on_message, on_end, self.prepare)
