"""Ray actor that hosts one scene process on the node chosen by Ray.

The process is a child of the actor. It therefore runs as it does without a cluster (signals, niceness, threads), and
its exit code is available, which Ray does not report for actors. The process ends when its actor ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from server.cluster.folder_marker import has_marker
from server.health.oom import oom_kills
from server.processes.placement import Entry, Placement, ProcessExit, ProcessHandle


@dataclass(frozen=True)
class StartResult:
    """Result of starting a process; `fault` is the reason if the process did not start, otherwise None."""

    node: str
    pid: int | None = None
    fault: str | None = None


@dataclass(frozen=True)
class UnexpectedExit:
    """Message that the process exited without being asked to; see `ProcessExit` for the attributes."""

    exit_code: int | None
    out_of_memory: bool = False


@dataclass(frozen=True)
class ProcessScheduling:
    """Thread count and niceness applied to processes on every node, equal to those on the service's machine.

    Attributes:
        threads: value of OMP_NUM_THREADS, which Ray would otherwise set to the actor's number of CPUs.
        nice: niceness, which Ray would otherwise raise by 15, making a worker yield to every other process on its node.
    """

    threads: str | None = None
    nice: int = 0

    @classmethod
    def current(cls) -> ProcessScheduling:
        """Returns the OpenMP thread count and niceness of this process."""
        return cls(os.environ.get("OMP_NUM_THREADS"), os.getpriority(os.PRIO_PROCESS, 0))

    def apply(self) -> None:
        """Applies both settings to this thread and the processes that it starts.

        The niceness is lowered only if the user is permitted to do so.
        """
        os.environ.pop("OMP_NUM_THREADS", None)
        if self.threads is not None:
            os.environ["OMP_NUM_THREADS"] = self.threads
        with contextlib.suppress(PermissionError):  # docs/cluster.md describes a workaround
            os.setpriority(os.PRIO_PROCESS, 0, self.nice)


@contextlib.contextmanager
def _without_main_module() -> Iterator[None]:
    """Prevents processes spawned inside the context from importing this process's main module.

    Ray's main module takes 40 MB.
    """
    main = vars(sys.modules["__main__"])
    file = main.pop("__file__", None)
    try:
        yield
    finally:
        if file is not None:
            main["__file__"] = file


def _node_id() -> str:
    """Returns the id of the node that runs this actor."""
    import ray

    return str(ray.get_runtime_context().get_node_id())


class ProcessHost:
    """Actor that starts a process, forwards its messages in order, and reports how it exited.

    Args:
        prepare: function that is called first in the process; see `Placement`.
        data: the service's data folder, which must be visible on this node.
        word: content of the service's marker file in that folder.
        priority: scheduling of the service's process; None keeps the scheduling of this process.
    """

    def __init__(
        self, prepare: Callable[[], None] | None, data: Path, word: str, priority: ProcessScheduling | None = None
    ) -> None:
        self._priority = priority
        self._placement = Placement(prepare)
        self._data, self._word = data, word
        self._received: asyncio.Queue[Any] = asyncio.Queue()
        self._process: ProcessHandle | None = None
        self._out_of_order: dict[int, Any] = {}
        self._next = 0
        self._oom_kills = oom_kills()

    async def start(self, entry: Entry, spec: Any) -> StartResult:
        """Starts the process if this node sees the data folder and can write to it."""
        node = _node_id()
        if not await asyncio.to_thread(has_marker, self._data, self._word):
            fault = f"node {socket.gethostname()} cannot see the data folder {self._data}; mount it on that node"
            return StartResult(node, fault=fault)
        if not os.access(self._data, os.R_OK | os.W_OK | os.X_OK):
            return StartResult(node, fault=f"node {socket.gethostname()} cannot write to the data folder {self._data}")
        if self._priority is not None:
            self._priority.apply()  # in this thread: the process inherits the niceness of the thread that starts it
        with _without_main_module():
            self._process = self._placement.start(entry, spec, self._received.put_nowait, self._on_end)
        self._deliver()  # delivers messages that were posted before the start
        return StartResult(node, self._process.pid)

    async def post(self, number: int, message: Any) -> None:
        """Sends a message to the process.

        Messages are delivered in the order of `number`, because Ray may reorder calls.
        """
        self._out_of_order[number] = message
        self._deliver()

    def _deliver(self) -> None:
        while self._process is not None and self._next in self._out_of_order:
            self._process.send(self._out_of_order.pop(self._next))
            self._next += 1

    async def receive(self) -> list[Any]:
        """Waits for messages from the process and returns at least one of them.

        After an unexpected exit of the process, the last message is `UnexpectedExit`.
        """
        messages = [await self._received.get()]
        while not self._received.empty():
            messages.append(self._received.get_nowait())
        return messages

    async def stop(self, seconds: float) -> None:
        """Asks the process to exit, waits up to `seconds`, then kills it."""
        if self._process is not None:
            process, self._process = self._process, None
            await process.stop(seconds)

    def _on_end(self, why: ProcessExit) -> None:
        self._process = None
        self._received.put_nowait(UnexpectedExit(why.exit_code, oom_kills() > self._oom_kills))
