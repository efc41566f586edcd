"""Monitors the nodes of the cluster.

Ray is polled at a limited rate, and requests wait only briefly for the head node.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

AllNodes = Sequence[Mapping[str, Any]]

POLL_S = 2.0
"""Minimum interval in seconds between requests to the head node."""
TIMEOUT_S = 2.0
"""Maximum time in seconds to wait for the head node before the previous answer is used."""
LOST_KEPT_S = 900.0
"""Time in seconds for which a lost node stays in reports, so that scrapers and operators do not miss it."""
MOST_LOST = 16
"""Maximum number of lost nodes to report."""
EXPECTED_REASON = (1, 4)
"""Ray's codes for nodes that do not count as lost: stopped by `ray stop`, or removed by the autoscaler when idle."""


class NodeWatch:
    """Tracks the node list of the head node and the recently lost nodes. Use it only on the event loop.

    Args:
        ask: function that requests the list of all current and former nodes, in Ray's format, and returns a future.
        now: monotonic clock that returns seconds.

    Attributes:
        nodes: latest node list received.
        head_responds: whether the head node answered the latest request within `TIMEOUT_S`.
    """

    def __init__(self, ask: Callable[[], asyncio.Future[Any]], now: Callable[[], float] = time.monotonic) -> None:
        self.nodes: AllNodes = ()
        self.head_responds = True
        self._ask, self._now = ask, now
        self._asked = -POLL_S
        self._answer: asyncio.Future[AllNodes] | None = None
        self._alive: set[str] = set()
        self._lost: dict[str, float] = {}

    @property
    def lost(self) -> list[str]:
        """Ids of recently lost nodes whose machines have not rejoined."""
        since = self._now() - LOST_KEPT_S
        return [id for id, when in self._lost.items() if when >= since]

    async def poll(self) -> None:
        """Requests the node list, at most once per `POLL_S`, and waits up to `TIMEOUT_S` for the response."""
        now = self._now()
        if self._answer is None and now - self._asked >= POLL_S:
            self._asked = now
            self._answer = self._ask()
            self._answer.add_done_callback(self._on_answer)
        if self._answer is not None:
            left = self._asked + TIMEOUT_S - now
            done, _ = await asyncio.wait({self._answer}, timeout=max(0.0, left))
            self.head_responds = self.head_responds and bool(done)

    def _on_answer(self, answer: asyncio.Future[AllNodes]) -> None:
        self._answer = None
        self.head_responds = not answer.cancelled() and answer.exception() is None
        if self.head_responds:
            self.record(answer.result())

    def record(self, nodes: AllNodes) -> None:
        """Stores a node list and records which nodes were lost since the previous list."""
        self.nodes = nodes
        hosts = {node["NodeID"]: node["NodeManagerHostname"] for node in nodes}
        alive = {node["NodeID"] for node in nodes if node["Alive"]}
        stopped = {node["NodeID"] for node in nodes if node.get("DeathReason") in EXPECTED_REASON}
        back = {hosts[id] for id in alive - self._alive}
        now = self._now()
        lost = self._lost | dict.fromkeys(sorted(self._alive - alive - stopped), now)
        lost = {id: when for id, when in lost.items() if hosts.get(id) not in back}
        self._lost = dict(list(lost.items())[-MOST_LOST:])
        self._alive = alive
