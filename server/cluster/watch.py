"""Watches the nodes of the cluster: asks Ray seldom, and never keeps a request waiting for its head."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

AllNodes = Sequence[Mapping[str, Any]]

FRESH_S = 2.0
"""An answer of the head is good for so long."""
PATIENCE_S = 2.0
"""A request waits for the head for so long; then it gets the answer before."""
KEPT_S = 900.0
"""Seconds for which a lost node is reported: scrapers and people look every few seconds, or miss a moment."""
MOST_LOST = 16
ON_PURPOSE = (1, 4)
"""Ray's reasons for a node that was stopped (`ray stop`), or was idle and ended by its autoscaler: it is not lost."""


class NodeWatch:
    """Nodes as the head of the cluster listed them last, and those that were lost lately. On the event loop.

    Args:
        ask: asks the head for all nodes that there have been, as Ray describes them; returns a future of the answer.
        now: seconds of a clock that never goes back.

    Attributes:
        nodes: of the newest answer. answers: whether the head gave it within `PATIENCE_S`.
    """

    def __init__(self, ask: Callable[[], asyncio.Future[Any]], now: Callable[[], float] = time.monotonic) -> None:
        self.nodes: AllNodes = ()
        self.answers = True
        self._ask, self._now = ask, now
        self._asked = -FRESH_S
        self._answer: asyncio.Future[AllNodes] | None = None
        self._alive: set[str] = set()
        self._lost: dict[str, float] = {}

    @property
    def lost(self) -> list[str]:
        """Ids of nodes that were lost lately, and whose machine has not joined again."""
        since = self._now() - KEPT_S
        return [id for id, when in self._lost.items() if when >= since]

    async def look(self) -> None:
        """Asks the head, unless it was just asked, and waits for its answer for a moment."""
        now = self._now()
        if self._answer is None and now - self._asked >= FRESH_S:
            self._asked = now
            self._answer = self._ask()
            self._answer.add_done_callback(self._take)
        if self._answer is not None:
            left = self._asked + PATIENCE_S - now
            done, _ = await asyncio.wait({self._answer}, timeout=max(0.0, left))
            self.answers = self.answers and bool(done)

    def _take(self, answer: asyncio.Future[AllNodes]) -> None:
        self._answer = None
        self.answers = not answer.cancelled() and answer.exception() is None
        if self.answers:
            self.saw(answer.result())

    def saw(self, nodes: AllNodes) -> None:
        """Notes which nodes are lost since the answer before."""
        self.nodes = nodes
        hosts = {node["NodeID"]: node["NodeManagerHostname"] for node in nodes}
        alive = {node["NodeID"] for node in nodes if node["Alive"]}
        stopped = {node["NodeID"] for node in nodes if node.get("DeathReason") in ON_PURPOSE}
        back = {hosts[id] for id in alive - self._alive}
        now = self._now()
        lost = self._lost | dict.fromkeys(sorted(self._alive - alive - stopped), now)
        lost = {id: when for id, when in lost.items() if hosts.get(id) not in back}
        self._lost = dict(list(lost.items())[-MOST_LOST:])
        self._alive = alive
