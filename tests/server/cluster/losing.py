"""A Ray in whose place a service is a member of a cluster that it can lose; for tests where Ray is installed."""

from __future__ import annotations

import ray

from server.cluster import membership


class LosableCluster:
    """Attributes: lost: the node of this machine is. refuses: so many tries to join. looks_done: at whether it is lost.
    inits, events: what was done.
    """

    def __init__(self, monkeypatch) -> None:
        self.events: list[str] = []
        self.lost = self.joined = False
        self.refuses = self.inits = self.looks_done = 0
        monkeypatch.setattr(membership, "CHECK_S", 0.01)
        monkeypatch.setattr(membership, "own_node_is_lost", self._is_lost)
        monkeypatch.setattr(ray, "is_initialized", lambda: self.joined)
        monkeypatch.setattr(ray, "init", self._init)
        monkeypatch.setattr(ray, "shutdown", self._shutdown)

    def _is_lost(self) -> bool:
        self.looks_done += 1
        return self.lost

    def _init(self, **options) -> None:
        self.inits += 1
        if self.refuses:
            self.refuses -= 1
            raise ConnectionError("no node on this machine")
        self.joined, self.lost = True, False
        self.events.append("joined")

    def _shutdown(self) -> None:
        self.joined = False
        self.events.append("left")
