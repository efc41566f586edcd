"""The actor that has one process of a scene, on whichever node Ray has placed it.

The process is a child of the actor: it runs as it does on one machine (signals, niceness, threads), and how it ended is
known by its exit code, which Ray does not report. It ends with the actor.
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

from server.cluster.marks import is_marked
from server.health.oom import oom_kills
from server.processes.placement import AnyProcess, Entry, Placement, ProcessExit


@dataclass(frozen=True)
class Started:
    """The process runs, or does not: `fault` says why."""

    node: str
    pid: int | None = None
    fault: str | None = None


@dataclass(frozen=True)
class NodeGone:
    """The process ended without being asked to, with this exit code; `starved`: see `ProcessExit`."""

    exit_code: int | None
    starved: bool = False


@dataclass(frozen=True)
class ProcessPriority:
    """Sets how processes run: as on the machine of the service; Ray starts its own otherwise.

    Attributes:
        threads: OMP_NUM_THREADS, which Ray sets to an actor's CPUs. nice: niceness, which Ray raises by 15: a worker
            then gives way to all else on its node, to idle daemons too.
    """

    threads: str | None = None
    nice: int = 0

    @classmethod
    def here(cls) -> ProcessPriority:
        """Of this process."""
        return cls(os.environ.get("OMP_NUM_THREADS"), os.getpriority(os.PRIO_PROCESS, 0))

    def take(self) -> None:
        """Takes it on, for this thread and what it starts; less nice than now only where the user may."""
        os.environ.pop("OMP_NUM_THREADS", None)
        if self.threads is not None:
            os.environ["OMP_NUM_THREADS"] = self.threads
        with contextlib.suppress(PermissionError):  # docs/cluster.md says how the node is started instead
            os.setpriority(os.PRIO_PROCESS, 0, self.nice)


@contextlib.contextmanager
def _no_program() -> Iterator[None]:
    """A process that is spawned inside does not load the program of this one: Ray's is 40 MB."""
    main = vars(sys.modules["__main__"])
    file = main.pop("__file__", None)
    try:
        yield
    finally:
        if file is not None:
            main["__file__"] = file


def _node_id() -> str:
    """Of the node that this actor is on."""
    import ray

    return str(ray.get_runtime_context().get_node_id())


class Host:
    """Starts the process, hands its messages on in order, and says how it ended.

    Args:
        prepare: see `Placement`. data: folder of the service, which this node has to see. word: of the service's mark
            in it. priority: of the service; None: of this process.
    """

    def __init__(
        self, prepare: Callable[[], None] | None, data: Path, word: str, priority: ProcessPriority | None = None
    ) -> None:
        self._manner = priority
        self._placement = Placement(prepare)
        self._data, self._word = data, word
        self._said: asyncio.Queue[Any] = asyncio.Queue()
        self._process: AnyProcess | None = None
        self._early: dict[int, Any] = {}
        self._next = 0
        self._oom_kills = oom_kills()

    async def start(self, entry: Entry, spec: Any) -> Started:
        """Starts the process."""
        node = _node_id()
        if not await asyncio.to_thread(is_marked, self._data, self._word):
            fault = f"node {socket.gethostname()} does not see the data folder {self._data}; mount it there"
            return Started(node, fault=fault)
        if not os.access(self._data, os.R_OK | os.W_OK | os.X_OK):
            return Started(node, fault=f"node {socket.gethostname()} cannot write to the data folder {self._data}")
        if self._manner is not None:
            self._manner.take()  # here: the niceness is that of the thread that starts the process
        with _no_program():
            self._process = self._placement.start(entry, spec, self._said.put_nowait, self._ended)
        self._hand_on()  # what was posted before
        return Started(node, self._process.pid)

    async def post(self, number: int, message: Any) -> None:
        """Posts a message to the process; by their numbers, as Ray may call in another order."""
        self._early[number] = message
        self._hand_on()

    def _hand_on(self) -> None:
        while self._process is not None and self._next in self._early:
            self._process.send(self._early.pop(self._next))
            self._next += 1

    async def take(self) -> list[Any]:
        """The next messages of the process, one at least; `NodeGone` is the last."""
        messages = [await self._said.get()]
        while not self._said.empty():
            messages.append(self._said.get_nowait())
        return messages

    async def stop(self, seconds: float) -> None:
        """Asks the process to end, waits for so long, then kills it."""
        if self._process is not None:
            process, self._process = self._process, None
            await process.stop(seconds)

    def _ended(self, why: ProcessExit) -> None:
        self._process = None
        self._said.put_nowait(NodeGone(why.exit_code, oom_kills() > self._oom_kills))
