"""Nodes as the head of the cluster tells them: it is asked seldom, never waited for long, and lost ones are kept."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Mapping
from typing import Any

import pytest
from waiting import HANG_S

from server.cluster import node_watch
from server.cluster.node_watch import LOST_KEPT_S, MOST_LOST, NodeWatch


def node(id: str, host: str = "", *, alive: bool = True, reason: int = 0) -> dict[str, Any]:
    return {"NodeID": id, "NodeManagerHostname": host or id, "Alive": alive, "DeathReason": reason}


class Head:
    """Tells nodes; `silent` keeps it from answering, `fault` is raised."""

    def __init__(self, *nodes: Mapping[str, Any]) -> None:
        self.nodes, self.asked, self.seconds = nodes, 0, 0.0
        self.fault: Exception | None = None
        self.speaks = threading.Event()
        self.speaks.set()
        self.watch = NodeWatch(self._ask, lambda: self.seconds)

    def _ask(self) -> asyncio.Future[Any]:
        return asyncio.get_running_loop().run_in_executor(None, self._all)

    def _all(self) -> tuple[Mapping[str, Any], ...]:
        self.asked += 1
        self.speaks.wait(HANG_S)
        if self.fault is not None:
            raise self.fault
        return self.nodes

    async def tells(self, *nodes: Mapping[str, Any]) -> list[str]:
        """Tells other nodes, and the watch looks once it may ask again; the lost ones."""
        self.nodes, self.seconds = nodes, self.seconds + node_watch.POLL_S
        await self.watch.poll()
        return self.watch.lost


def test_requests_side_by_side_ask_once_and_an_answer_is_good_for_a_moment() -> None:
    async def run() -> None:
        head = Head(node("a"))
        await asyncio.gather(*(head.watch.poll() for _ in range(5)))
        await head.watch.poll()
        assert (head.asked, len(head.watch.nodes), head.watch.head_responds) == (1, 1, True)
        head.seconds += node_watch.POLL_S
        await head.watch.poll()
        assert head.asked == 2

    asyncio.run(run())


def test_a_head_that_does_not_answer_is_waited_for_once_and_asked_by_one_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(node_watch, "TIMEOUT_S", 0.2)

    async def run() -> None:
        head = Head(node("a"))
        await head.watch.poll()
        head.speaks.clear()
        head.seconds += node_watch.POLL_S
        began = time.monotonic()
        await head.watch.poll()
        assert time.monotonic() - began > 0.15
        for _ in range(3):
            head.seconds += node_watch.POLL_S
            await head.watch.poll()
        assert (head.asked, head.watch.head_responds, len(head.watch.nodes)) == (2, False, 1)
        head.speaks.set()
        while not head.watch.head_responds:
            await asyncio.sleep(0.01)
            await head.watch.poll()

    asyncio.run(run())


def test_a_head_that_fails_is_told_and_asked_again() -> None:
    async def run() -> None:
        head = Head(node("a"))
        head.fault = RuntimeError("no head")
        await head.watch.poll()
        assert not head.watch.head_responds
        head.fault = None
        await head.tells(node("a"))
        assert head.watch.head_responds

    asyncio.run(run())


def test_a_node_that_is_lost_is_kept_for_a_while() -> None:
    async def run() -> None:
        head = Head(node("a"), node("b"), node("old", alive=False))
        await head.watch.poll()
        assert head.watch.lost == []  # one that was dead before is none of this service's
        gone = node("b", alive=False, reason=2)
        assert await head.tells(node("a"), gone) == ["b"]
        assert await head.tells(node("a"), gone) == ["b"]
        head.seconds += LOST_KEPT_S
        assert await head.tells(node("a"), gone) == []

    asyncio.run(run())


def test_one_that_was_stopped_on_purpose_or_joins_again_is_not_lost() -> None:
    async def run() -> None:
        head = Head(node("a", "one"), node("b", "two"), node("c", "three"))
        await head.watch.poll()
        stopped, gone = node("b", "two", alive=False, reason=1), node("c", "three", alive=False, reason=2)
        assert await head.tells(node("a", "one"), stopped, gone) == ["c"]
        assert await head.tells(node("a", "one"), stopped, gone, node("d", "three")) == []

    asyncio.run(run())


def test_the_number_of_lost_ones_is_bounded() -> None:
    async def run() -> None:
        many = [f"n{number:02}" for number in range(2 * MOST_LOST)]
        head = Head(*map(node, many))
        await head.watch.poll()
        assert len(await head.tells(*(node(id, alive=False) for id in many))) == MOST_LOST

    asyncio.run(run())
