"""Starts the processes of the scenes, carries their messages and notices their end.

Processes are spawned, never forked: the service has threads, and Numba and CUDA do not survive a fork.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any, NoReturn, Protocol

from client.wire import Cluster
from server.messages import Stop

Entry = Callable[..., None]
"""Called in the process as entry(spec, connection); `connection` has recv and send of a multiprocessing Connection."""

STOP_SECONDS = 5.0
"""Grace for a process to end by itself when a scene or the service stops; an unfinished frame is taken up again."""
PARENT_CHECK_S = 0.5
"""A process notices so late that the service has ended."""

_context = multiprocessing.get_context("spawn")


class ProcessExit(str):
    """A sentence that says why a process ended.

    Attributes:
        exit_code: as in multiprocessing: −N for signal N; None if unknown.
        lost: its machine is gone or unreachable. out_of_memory: the kernel killed processes of its control group for
            lack of memory; None: look at the control group of this machine.
    """

    exit_code: int | None
    lost: bool
    out_of_memory: bool | None

    def __new__(
        cls, exit_code: int | None, why: str = "", *, lost: bool = False, out_of_memory: bool | None = None
    ) -> ProcessExit:
        """Makes the sentence for an exit code, or takes another."""
        self = super().__new__(cls, why or f"its process ended by itself (exit code {exit_code})")
        self.exit_code, self.lost, self.out_of_memory = exit_code, lost, out_of_memory
        return self


def end_with_parent() -> None:
    """Ends this process soon after the one that started it: for processes that may be busy for long."""
    starter = multiprocessing.parent_process()
    parent = os.getppid() if starter is None else starter.pid  # it may have ended by now

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_S)
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()


def enter_background(nice: int) -> None:
    """Begins a process that does one thing beside the updates: less eager than they are, and gone with its parent.

    Args:
        nice: added to its niceness.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the service says when to stop
    os.nice(nice)
    end_with_parent()


def finish_background(connection: Connection[Any, Any], ended: Any) -> NoReturn:
    """Ends it: sends its last message, and waits to be asked to stop. An end of its own would be taken for a fault."""
    with contextlib.suppress(EOFError, OSError):  # the service is gone
        connection.send(ended)
        logging.shutdown()
        connection.recv()
    os._exit(0)


def use_one_thread() -> None:
    """Keeps this process to one thread of Numba, OpenMP and BLAS: the other cores belong to the updates."""
    import numba
    from threadpoolctl import threadpool_limits

    numba.set_num_threads(1)
    threadpool_limits(1)  # scikit-learn's threads spin while they wait: 16 s for a part query on busy cores


class ProcessHandle(Protocol):
    """A running process of a scene, wherever it is."""

    @property
    def pid(self) -> int | None:
        """The process id on its machine; None while it is not known."""

    def send(self, message: Any) -> None:
        """Posts a message and returns at once; messages to a process that has ended are dropped."""

    async def stop(self, seconds: float = STOP_SECONDS) -> None:
        """Asks the process to end, waits for `seconds`, then kills it."""


class LocalProcess:
    """A running process on this machine. Two threads move its messages, and the event loop never waits on a pipe."""

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
        """The process id of the operating system."""
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
        self._outbox.put(None)  # stop may never be called: the other thread ends with the process
        self._call(self._on_end, ProcessExit(code))

    def _call(self, function: Callable[[Any], None], argument: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop has closed
            self._loop.call_soon_threadsafe(function, argument)


def _run(prepare: Callable[[], None] | None, entry: Entry, spec: Any, connection: Connection[Any, Any]) -> None:
    if prepare is not None:
        prepare()
    entry(spec, connection)


class Placement:
    """Runs every process of every scene on this machine.

    Args:
        prepare: called first in every process, before its entry imports the core; it has to pickle. The service sets up
            its logs with it, and tests put a fake in place of the core.

    Attributes:
        fenced: workers get epochs (`server.storage.fencing`): one may go on after it was taken for dead.
        has_peers: other services may have scenes of the same cluster.
        has_labels: it runs processes on nodes that have labels, of which a scene may ask for some.
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
            entry: the module-level function that runs there.
            spec: its first argument; it has to pickle.
            on_message: called on the event loop with every message that the process sends.
            on_end: called on the event loop once, with the reason, when the process ended without being asked to.
        """
        return LocalProcess(entry, spec, on_message, on_end, self.prepare)

    async def cluster(self) -> Cluster | None:
        """The machines on which processes run; None: this one alone."""
        return None

    async def announce(self, host: str, port: int) -> None:
        """Announces to other services of the cluster where this one listens."""

    async def peers(self) -> Sequence[str]:
        """Addresses of the other services of the cluster, as `http://10.0.0.2:8000`."""
        return ()

    async def open(self) -> None:
        """Makes ready to start processes; called once, before any."""

    async def close(self) -> None:
        """Gives back what `open` took, when all processes have ended."""
