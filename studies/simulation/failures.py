"""Random failures of nodes, of workers, of the service and of the cluster's head."""

from __future__ import annotations

import asyncio
from collections import Counter
from enum import StrEnum
from random import Random

from studies.simulation.cluster import SimulatedCluster
from studies.simulation.delays import PAUSE_S, Range
from studies.simulation.service import SimulatedService

AGAIN_S = 5.0
"""Delay before a failure is tried again if it found no target, for example no running node."""


class Failure(StrEnum):
    """Kind of failure, with its description as the value."""

    KILLED = "a node killed"
    STOPPED = "a node stopped and continued"
    CUT = "a node cut off by the network"
    WORKER = "a worker killed"
    SERVICE = "the service killed"
    HEAD = "the head of the cluster silent"


SHARES = {
    Failure.KILLED: 0.32,
    Failure.STOPPED: 0.20,
    Failure.CUT: 0.16,
    Failure.WORKER: 0.30,
    Failure.SERVICE: 0.01,
    Failure.HEAD: 0.01,
}
LEAST = 2
"""Smallest number of failures of each kind."""


def drawn(total: int, begin: float, end: float, random: Random) -> list[tuple[float, Failure]]:
    """Draws failures at uniformly distributed times, by their shares. Node kills make up the rest of the total.

    >>> found = drawn(60, 0, 10, Random(0))
    >>> len(found), sum(failure is Failure.SERVICE for _, failure in found)
    (60, 2)
    """
    others = [kind for kind, share in SHARES.items() for _ in range(max(LEAST, round(share * total)))]
    others = [kind for kind in others if kind is not Failure.KILLED]
    kinds = others + [Failure.KILLED] * (total - len(others))
    return [(random.uniform(begin, end), kind) for kind in kinds]


class Failures:
    """Triggers failures at scheduled times.

    Args:
        cluster: the cluster.
        service: the service.
        silent: shortest and longest time for which the head does not respond, in seconds.

    Attributes:
        happened: number of failures that have happened, keyed by kind.
    """

    def __init__(self, cluster: SimulatedCluster, service: SimulatedService, silent: Range) -> None:
        self.happened: Counter[Failure] = Counter()
        self._cluster, self._service, self._silent = cluster, service, silent
        self._restart: asyncio.Task[None] | None = None

    def plan(self, moments: list[tuple[float, Failure]]) -> None:
        """Schedules failures, given as pairs of time in seconds and kind."""
        for when, failure in moments:
            self._cluster.loop.call_at(when, self._happen, failure)

    def _happen(self, failure: Failure) -> None:
        if self._fail(failure):
            self.happened[failure] += 1
        else:
            self._cluster.loop.call_later(AGAIN_S, self._happen, failure)

    def _fail(self, failure: Failure) -> bool:
        cluster, random = self._cluster, self._cluster.random
        match failure:
            case Failure.SERVICE:
                if not self._service.up:
                    return False
                self._restart = cluster.loop.create_task(self._service.restart())
            case Failure.HEAD:
                if not cluster.answers:
                    return False
                cluster.head_down(random.uniform(*self._silent))
            case Failure.WORKER:
                if not (working := self._service.placement.working()):
                    return False
                random.choice(working).die()
            case _:
                if not (nodes := cluster.running()):
                    return False
                node = random.choice(nodes)
                if failure is Failure.KILLED:
                    cluster.kill(node)
                elif failure is Failure.STOPPED:
                    cluster.stop(node, random.uniform(*PAUSE_S))
                else:
                    cluster.cut(node, random.uniform(*PAUSE_S))
        return True
