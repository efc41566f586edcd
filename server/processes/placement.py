"""Placement of scene processes: starts them, exchanges messages with them, and detects when they exit.

Processes are spawned, never forked: the service has threads, and Numba and CUDA do not survive a fork.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import queue
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any, Protocol

from client.wire import Cluster
from server.messages import Stop

Entry = Callable[..., None]
"""Entry point of a process, called as `entry(spec, connection)`.

`connection` has the `recv` and `send` methods of a multiprocessing Connection.
"""

STOP_SECONDS = 5.0
"""Time in seconds for a process to exit on its own when its scene or the service stops.

An unfinished frame is processed again after the restart.
"""
PARENT_CHECK_S = 0.5
"""Interval in seconds between a process's checks that the service is still running."""

_context = multiprocessing.get_context("spawn")


class ProcessExit(str):
    """Reason why a process exited, as text.

    Attributes:
        exit_code: exit code as in multiprocessing, −N for signal N; None if unknown.
        lost: whether the process's machine is down or unreachable.
        out_of_memory: whether the kernel's OOM killer killed processes in the process's control group. If None,
            the caller must check the control group of this machine.
    """

    exit_code: int | None
    lost: bool
    out_of_memory: bool | None

    def __new__(
        cls, exit_code: int | None, why: str = "", *, lost: bool = False, out_of_memory: bool | None = None
    ) -> ProcessExit:
        """Creates the reason from `why` if given, otherwise from the exit code."""
        self = super().__new__(cls, why or f"exit code {exit_code}")
        self.exit_code, self.lost, self.out_of_memory = exit_code, lost, out_of_memory
        return self


def end_with_parent() -> None:
    """Makes this process exit soon after its parent has exited.

    Call this function in processes that may be busy for a long time.
    """
    starter = multiprocessing.parent_process()
    parent = os.getppid() if starter is None else starter.pid  # the parent may have exited already

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_S)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()


def use_one_thread() -> None:
    """Limits Numba, OpenMP and BLAS to one thread in this process, leaving the other cores to updates."""
    import numba
    from threadpoolctl import threadpool_limits

    numba.set_num_threads(1)
    threadpool_limits(1)  # threads of scikit-learn busy-wait: a part query took 16 s on busy cores


class ProcessHandle(Protocol):
    """Handle of a running scene process on any machine."""

    @property
    def pid(self) -> int | None:
        """Process id on the machine of the process; None while unknown."""

    def send(self, message: Any) -> None:
        """Sends a message without blocking; messages to an exited process are dropped."""

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Asks the process to exit, waits up to `seconds`, then kills it."""


class LocalProcess:
    """Process on this machine; two threads transfer its messages, so that the event loop never blocks on a pipe."""

    def __init__(
        self,
        entry: Entry,
        spec: Any,
        on_message: Callable[[Any], None],
        on_end: Callable[[ProcessExit], None],
        prepare: Callable[[], None] | None = None,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._on_message = on_message
        self._on_end = on_end
        self._stopping = False
        self._reaping = threading.Lock()  # multiprocessing does not support two threads joining one process
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._connection, theirs = _context.Pipe()
        self._process = _context.Process(target=_run, args=(prepare, entry, spec, theirs), daemon=True)
        # Starting blocks the event loop for about 20 ms, which is acceptable because it is rare.
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
        """Process id of the process."""
        return self._process.pid

    def send(self, message: Any) -> None:
        """See `ProcessHandle`."""
        self._outbox.put(message)

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """See `ProcessHandle`."""
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
            with contextlib.suppress(OSError):  # the process has exited; the reading thread reports it
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
        self._outbox.put(None)  # ends the writing thread, since `stop` may never be called
        self._call(self._on_end, ProcessExit(code))

    def _call(self, function: Callable[[Any], None], argument: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop has closed
            self._loop.call_soon_threadsafe(function, argument)


def _run(prepare: Callable[[], None] | None, entry: Entry, spec: Any, connection: Connection[Any, Any]) -> None:
    if prepare is not None:
        prepare()
    entry(spec, connection)


class Placement:
    """Placement that runs every process of every scene on this machine.

    Args:
        prepare: picklable function that is called first in every process, before its entry point imports the core. The
            service uses it to configure logging; tests use it to replace the core with a fake.

    Attributes:
        fenced: whether workers get epochs (`server.storage.fencing`), because a worker may keep running after it was
            declared dead.
        has_peers: whether other services may own scenes of the same cluster.
        has_labels: whether nodes have labels that a scene may require.
    """

    fenced = False
    has_peers = False
    has_labels = False

    def __init__(self, prepare: Callable[[], None] | None = None) -> None:
        self.prepare = prepare

    def start(
        self, entry: Entry, spec: Any, on_message: Callable[[Any], None], on_end: Callable[[ProcessExit], None]
    ) -> ProcessHandle:
        """Starts a process.

        Args:
            entry: module-level function that runs in the process.
            spec: first argument of `entry`; it must be picklable.
            on_message: callback that receives each message from the process; called on the event loop.
            on_end: callback that receives the reason if the process exits unasked; called once, on the event loop.
        """
        return LocalProcess(entry, spec, on_message, on_end, self.prepare)

    async def cluster(self) -> Cluster | None:
        """Returns the machines that run processes, or None if all processes run on this machine."""
        return None

    async def announce(self, host: str, port: int) -> None:
        """Announces the address of this service to the other services of the cluster."""

    async def peers(self) -> Sequence[str]:
        """Returns the addresses of the other services of the cluster, such as `http://10.0.0.2:8000`."""
        return ()

    async def open(self) -> None:
        """Acquires the resources needed to start processes; called once, before the first start."""

    async def close(self) -> None:
        """Releases the resources acquired by `open`; called after all processes have exited."""
