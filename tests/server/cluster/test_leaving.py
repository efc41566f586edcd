"""A service that leaves its cluster asks Ray nothing meanwhile, and drops nothing of Ray's; Ray is a fake here."""

from __future__ import annotations

import asyncio
import gc
import threading
import weakref
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from waiting import HANG_S, wait_for_soon

ray_placement = pytest.importorskip(
    "server.cluster.ray_placement", reason="Ray is not installed: pip install 'scas4d[ray]'"
)

from server.cluster import membership  # noqa: E402
from server.cluster.process_host import StartResult  # noqa: E402
from server.cluster.resource_needs import ResourceNeeds  # noqa: E402
from server.processes.placement import ProcessExit  # noqa: E402
from server.settings import ServerSettings  # noqa: E402
from tests.server.cluster.losing import LosableCluster  # noqa: E402
from tests.server.cluster.others import others_have_called  # noqa: E402


class Answer:
    """An answer of Ray's; it comes at once, or never."""

    def __init__(self, *result: Any) -> None:
        self.result = result

    def __await__(self) -> Any:
        if not self.result:
            yield from asyncio.Event().wait().__await__()
        return self.result[0]


class Method:
    def __init__(self, answer: Callable[[], Answer]) -> None:
        self.remote = lambda *arguments: answer()


class Cluster(LosableCluster):
    """With a placement; `looks` is called while the service leaves, which takes until `may_leave` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(monkeypatch)
        self.looks: Callable[[], None] = lambda: None
        self.leaves, self.may_leave = threading.Event(), threading.Event()
        self.may_leave.set()
        self.pending: list[weakref.ref[Answer]] = []
        self.exits: list[int] = []
        monkeypatch.setattr(ray_placement.ray, "kill", lambda actor: None)
        monkeypatch.setattr(membership.os, "_exit", self.exits.append)
        for name in ("check_folder", "write_marker", "register_service"):
            monkeypatch.setattr(ray_placement, name, lambda *arguments: None)
        monkeypatch.setattr(ray_placement, "all_nodes", list)
        monkeypatch.setattr(ray_placement, "resource_needs", lambda *arguments: ResourceNeeds("worker", "scene", 1, 1))
        self.placement = ray_placement.RayPlacement(None, None, ServerSettings(data=Path("data")))
        monkeypatch.setattr(self.placement, "create_actor", self._host)
        self.ends: list[ProcessExit] = []

    def _shutdown(self) -> None:
        self.looks()
        self.leaves.set()
        self.may_leave.wait(HANG_S)
        super()._shutdown()

    def _host(self, name: str, needs: ResourceNeeds) -> Any:
        class Actor:
            start = Method(lambda: Answer(StartResult("node", 4711)))
            post = receive = stop = Method(self._never)

        return Actor()

    def _never(self) -> Answer:
        answer = Answer()
        self.pending.append(weakref.ref(answer))
        return answer

    async def started(self, on_end: Callable[[ProcessExit], None] | None = None) -> Any:
        class Spec:
            class folder:
                epoch = 0

        process = self.placement.start(lambda: None, Spec, lambda message: None, on_end or self.ends.append)
        await wait_for_soon(lambda: process.pid and self.pending)
        return process

    def dropped(self) -> int:
        return [answer() for answer in self.pending].count(None)


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Cluster:
    return Cluster(monkeypatch)


def run(cluster: Cluster, test: Callable[[], Awaitable[None]]) -> None:
    async def all_of() -> None:
        await cluster.placement.open()
        try:
            await test()
        finally:
            await cluster.placement.close()

    asyncio.run(all_of())


def test_answers_are_kept_until_the_service_has_left_and_calls_are_made_afterwards(cluster: Cluster) -> None:
    called: list[int] = []

    async def test() -> None:
        process = await cluster.started()
        process.send("message")
        stopping = asyncio.ensure_future((await cluster.started()).stop(100))
        await wait_for_soon(lambda: len(cluster.pending) - cluster.dropped() == 4)
        del process
        there = len(cluster.pending) - cluster.dropped()
        cluster.may_leave.clear()
        cluster.lost = True
        assert await asyncio.to_thread(cluster.leaves.wait, HANG_S)
        asked = cluster.placement.call_ray(called.append, 1)
        await asyncio.wait_for(stopping, HANG_S)
        await others_have_called()
        gc.collect()
        assert len(cluster.pending) - cluster.dropped() == there == 4
        assert called == []
        assert [end.lost for end in cluster.ends] == [True]
        cluster.may_leave.set()
        await asked
        assert cluster.inits == 2
        await wait_for_soon(lambda: gc.collect() >= 0 and cluster.dropped() == len(cluster.pending))

    run(cluster, test)


def test_what_only_cycles_hold_is_dropped_before(cluster: Cluster) -> None:
    """By itself the collector may come while the service leaves."""
    there: list[bool] = []

    async def test() -> None:
        answer = Answer()
        found, cycle = weakref.ref(answer), [answer]
        cycle.append(cycle)  # type: ignore[arg-type]
        del answer, cycle
        cluster.looks = lambda: there.append(found() is not None)
        cluster.lost = True
        await wait_for_soon(lambda: there)

    gc.disable()
    try:
        run(cluster, test)
    finally:
        gc.enable()
    assert there[0] is False


def test_a_service_that_ends_while_it_joins_again_drops_nothing(cluster: Cluster) -> None:
    async def test() -> None:
        process = await cluster.started()
        del process
        cluster.may_leave.clear()
        cluster.lost = True
        assert await asyncio.to_thread(cluster.leaves.wait, HANG_S)
        closing = asyncio.ensure_future(cluster.placement.close())
        await others_have_called()
        gc.collect()
        assert cluster.pending
        assert cluster.dropped() == 0
        cluster.may_leave.set()
        await closing

    async def all_of() -> None:
        await cluster.placement.open()
        await test()

    asyncio.run(all_of())


def test_what_ray_has_begun_is_waited_for_and_a_fault_of_one_scene_keeps_nobody(cluster: Cluster) -> None:
    over = threading.Event()
    when: list[bool] = []
    cluster.looks = lambda: when.append(over.is_set())

    def fails(end: ProcessExit) -> None:
        raise KeyError("a fault of the scene's")

    async def test() -> None:
        await cluster.started(fails)
        await cluster.started()
        begun = threading.Event()
        call = cluster.placement.call_ray(lambda: begun.set() or over.wait(HANG_S))
        await wait_for_soon(begun.is_set)
        cluster.lost = True
        await wait_for_soon(lambda: cluster.ends)  # that it is lost is known
        await others_have_called()
        assert not cluster.leaves.is_set()
        assert when == []
        over.set()
        await call
        await wait_for_soon(lambda: cluster.inits == 2)
        assert when == [True]
        assert [end.lost for end in cluster.ends] == [True]

    run(cluster, test)


def test_a_service_that_cannot_give_up_what_it_has_lost_ends(cluster: Cluster, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fails(processes: Any, seconds: float) -> None:
        raise KeyError("a fault of the service's")

    async def test() -> None:
        with monkeypatch.context() as patch:
            patch.setattr(cluster.placement, "_detach", fails)
            cluster.lost = True
            await wait_for_soon(lambda: cluster.exits)

    run(cluster, test)
    assert cluster.exits == [1]
