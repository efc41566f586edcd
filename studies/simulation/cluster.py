"""Ray from the service's point of view: a queue, a head that places processes, and nodes that fail and return."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Sequence
from random import Random

from server.cluster.resource_needs import ResourceNeeds
from studies.simulation.delays import NOTICED_S, PLACED_PER_S, REPLACED_S, SPREAD_ABOVE, TOP_SHARE, Range
from studies.simulation.nodes import Capacity, Node, NodeState, Placed


class SimulatedCluster:
    """Model of a Ray cluster, which places processes on nodes with room.

    Of the processes that fit on a node, the one that has waited longest is placed first.

    Args:
        count: number of nodes.
        cpus: CPUs per node.
        memory: bytes of memory per node.
        kinds: kinds of resource needs.
        random: generator that draws delays and nodes.

    Attributes:
        answers: whether the head responds, that is, places processes and detects failures.
    """

    def __init__(self, count: int, cpus: float, memory: int, kinds: Sequence[ResourceNeeds], random: Random) -> None:
        self.loop = asyncio.get_running_loop()
        self.random = random
        self.capacity = Capacity(kinds, self.loop.time)
        self.nodes: list[Node] = []
        self._cpus, self._memory = cpus, memory
        self._made = 0
        self._queues: list[deque[tuple[int, Placed]]] = [deque() for _ in kinds]
        self._queued = 0
        self._serving = False
        self.answers = True
        self._silent: list[Node] = []
        """Nodes that fell silent while the head did not respond."""
        for _ in range(count):
            self.join()

    def later(self, delay: Range | float, call: Callable[[], None]) -> asyncio.TimerHandle:
        """Calls a function after a delay in seconds, which is drawn at random if a range is given."""
        return self.loop.call_later(self.random.uniform(*delay) if isinstance(delay, tuple) else delay, call)

    def running(self) -> list[Node]:
        """Returns the running nodes that Ray considers alive."""
        return [node for node in self.nodes if node.listed and node.state is NodeState.RUNNING]

    # Placement.

    def queue(self, process: Placed) -> None:
        """Adds a process to the queue for a place on a node."""
        self._queued += 1
        self._queues[self.capacity.kind(process.needs)].append((self._queued, process))
        self._wake()

    def give(self, node: Node, process: Placed) -> None:
        """Removes a process from its node."""
        if node.give(process):
            self._changed(node)

    def _changed(self, node: Node) -> None:
        self.capacity.changed(node)
        self._wake()

    def _wake(self) -> None:
        if not self._serving and self.answers and self._first() is not None:
            self._serving = True
            self.later(1 / PLACED_PER_S, self._serve)

    def _first(self) -> int | None:
        """Returns the kind of the next process to place, or None if none can be placed."""
        best: tuple[int, int] | None = None
        for kind, queue in enumerate(self._queues):
            while queue and not queue[0][1].queued:  # it was given up meanwhile
                queue.popleft()
            if queue and self.capacity.listed[kind] and (best is None or queue[0][0] < best[0]):
                best = queue[0][0], kind
        return None if best is None else best[1]

    def _serve(self) -> None:
        self._serving = False
        if self.answers and (kind := self._first()) is not None:
            _, process = self._queues[kind].popleft()
            node = self._choose(process.needs)
            node.take(process)
            process.place(node)
            self._changed(node)

    def _choose(self, needs: ResourceNeeds) -> Node:
        candidates = []
        for node in self.nodes:
            if node.listed and node.fits(needs):
                load = node.load()
                candidates.append((load if load >= SPREAD_ABOVE else 0.0, node.number, node))
        candidates.sort(key=lambda entry: entry[:2])
        return self.random.choice(candidates[: max(1, int(TOP_SHARE * len(self.nodes)))])[2]

    # Failures.

    def join(self) -> None:
        """Adds a new node to the cluster."""
        node = Node(self._made, self._cpus, self._memory)
        self._made += 1
        self.nodes.append(node)
        self._changed(node)

    def kill(self, node: Node) -> None:
        """Kills a node with all its processes. A new node joins after a delay."""
        self._fails(node, NodeState.DEAD)
        for process in tuple(node.processes):
            process.kill()
        self.later(REPLACED_S, self.join)

    def stop(self, node: Node, seconds: float) -> None:
        """Stops a node and its workers for a number of seconds."""
        self._fails(node, NodeState.STOPPED)
        for process in tuple(node.processes):
            process.pause()
        self.later(seconds, lambda: self._back(node))

    def cut(self, node: Node, seconds: float) -> None:
        """Disconnects a node for a number of seconds. Its workers continue."""
        self._fails(node, NodeState.CUT)
        self.later(seconds, lambda: self._back(node))

    def head_down(self, seconds: float) -> None:
        """Suspends placement and failure detection by the head for a number of seconds."""
        self.answers = False
        self.capacity.head(False)
        self.later(seconds, self._head_back)

    def _fails(self, node: Node, state: NodeState) -> None:
        node.state, node.failed_at = state, self.loop.time()
        self._changed(node)
        self._check(node)

    def _check(self, node: Node) -> None:
        """Starts the health checks of a node that does not respond."""
        failed_at = node.failed_at
        self.later(NOTICED_S, lambda: self._notice(node, failed_at))

    def _notice(self, node: Node, failed_at: float) -> None:
        if node.state is NodeState.RUNNING or node.failed_at != failed_at:  # it came back in time
            return
        if not self.answers:
            self._silent.append(node)
            return
        node.listed = False
        self.nodes.remove(node)
        node.held.clear()
        self._changed(node)
        for process in tuple(node.processes):
            process.lost()

    def _back(self, node: Node) -> None:
        stopped, node.state = node.state is NodeState.STOPPED, NodeState.RUNNING
        if stopped:
            for process in tuple(node.processes):
                process.resume()
        if not node.listed:
            self.later(REPLACED_S, self.join)
            return
        held, node.held = node.held, []
        for call in held:
            call()
        self._changed(node)

    def _head_back(self) -> None:
        self.answers = True
        self.capacity.head(True)
        silent, self._silent = self._silent, []
        for node in silent:
            self._check(node)
        self._wake()
