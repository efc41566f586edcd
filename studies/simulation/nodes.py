"""Nodes of the modelled cluster, and the time during which at least one node had room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Protocol

from server.cluster.resource_needs import ResourceNeeds


class NodeState(Enum):
    """Actual state of a node, of which Ray learns with a delay."""

    RUNNING = auto()
    STOPPED = auto()
    """Stopped by SIGSTOP, together with its workers."""
    CUT = auto()
    """Disconnected. Its workers continue, but no messages get through."""
    DEAD = auto()


class Placed(Protocol):
    """Protocol of a process that can be placed on a node."""

    needs: ResourceNeeds

    @property
    def queued(self) -> bool:
        """Whether the process waits for a place."""

    def place(self, node: Node) -> None:
        """Called when Ray has chosen the node."""

    def pause(self) -> None:
        """Called when the node is stopped."""

    def resume(self) -> None:
        """Called when the node resumes."""

    def kill(self) -> None:
        """Called when the node has ended."""

    def lost(self) -> None:
        """Called when Ray considers the node lost."""


@dataclass(eq=False)
class Node:
    """A machine in the cluster.

    Attributes:
        number: node number.
        cpus: number of CPUs.
        memory: bytes of memory.
        state: actual state of the node.
        listed: whether Ray considers the node alive.
        failed_at: time at which it last fell silent, in seconds.
        processes: processes on the node.
        held: calls that are deferred until the node can be reached again, and dropped if Ray declares it lost.
    """

    number: int
    cpus: float
    memory: int
    state: NodeState = NodeState.RUNNING
    listed: bool = True
    failed_at: float = 0.0
    processes: dict[Placed, None] = field(default_factory=dict)
    held: list[Callable[[], None]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.free_cpus, self.free_memory = self.cpus, self.memory

    def fits(self, needs: ResourceNeeds) -> bool:
        """Returns whether there is room for a process."""
        return self.free_cpus >= needs.cpus and self.free_memory >= needs.memory

    def load(self) -> float:
        """Returns the used fraction of the node's scarcest resource."""
        return max(1 - self.free_cpus / self.cpus, 1 - self.free_memory / self.memory)

    def take(self, process: Placed) -> None:
        """Reserves the resources of a process."""
        self.processes[process] = None
        self.free_cpus -= process.needs.cpus
        self.free_memory -= process.needs.memory

    def give(self, process: Placed) -> bool:
        """Releases the resources of a process and returns whether it was on this node."""
        if process not in self.processes:
            return False
        del self.processes[process]
        self.free_cpus += process.needs.cpus
        self.free_memory += process.needs.memory
        return True


class Capacity:
    """Measures the seconds during which a running, reachable node had room, for each kind of resource needs.

    Args:
        kinds: kinds of resource needs.
        now: function that returns the current time.

    Attributes:
        listed: number of nodes with room per kind that Ray considers alive, including silent ones that are not yet
            declared lost.
    """

    def __init__(self, kinds: Sequence[ResourceNeeds], now: Callable[[], float]) -> None:
        self.kinds = kinds
        self.listed = [0] * len(kinds)
        self._numbers = {(needs.cpus, needs.memory): number for number, needs in enumerate(kinds)}
        self._now = now
        self._usable = [0] * len(kinds)
        self._seen: dict[Node, tuple[list[bool], list[bool]]] = {}
        self._answers = True
        self._since = [0.0] * len(kinds)
        self._seconds = [[0.0, 0.0] for _ in kinds]

    def kind(self, needs: ResourceNeeds) -> int:
        """Returns the kind of a process's resource needs."""
        return self._numbers[needs.cpus, needs.memory]

    def seconds(self, kind: int) -> tuple[float, float]:
        """Returns the seconds with room so far, and the part of them in which the head responded."""
        self._count(kind)
        total, answered = self._seconds[kind]
        return total, answered

    def changed(self, node: Node) -> None:
        """Updates the counts after a node has changed."""
        none = [False] * len(self.kinds)
        listed_before, usable_before = self._seen.get(node, (none, none))
        fits = [node.fits(needs) for needs in self.kinds]
        listed = fits if node.listed else none
        usable = listed if node.state is NodeState.RUNNING else none
        for kind in range(len(self.kinds)):
            self.listed[kind] += listed[kind] - listed_before[kind]
            if usable[kind] != usable_before[kind]:
                self._count(kind)
                self._usable[kind] += usable[kind] - usable_before[kind]
        self._seen[node] = listed, usable
        if not node.listed:
            del self._seen[node]

    def head(self, answers: bool) -> None:
        """Records whether the head responds."""
        for kind in range(len(self.kinds)):
            self._count(kind)
        self._answers = answers

    def _count(self, kind: int) -> None:
        now = self._now()
        if self._usable[kind]:
            spent = now - self._since[kind]
            self._seconds[kind][0] += spent
            self._seconds[kind][1] += spent * self._answers
        self._since[kind] = now
