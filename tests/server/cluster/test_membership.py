"""A service that loses the node of its machine: it gives up what ran, joins again, and is announced again."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest
from waiting import HANG_S, wait_for_soon

membership = pytest.importorskip("server.cluster.membership", reason="Ray is not installed: pip install 'scas4d[ray]'")

from tests.server.cluster.losing import LosableCluster  # noqa: E402


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> LosableCluster:
    return LosableCluster(monkeypatch)


def test_what_ran_is_given_up_first_and_the_service_is_announced_last(cluster: LosableCluster) -> None:
    member = membership.Membership(None)
    member.join()
    fails = [True]

    async def give_up() -> None:
        await asyncio.sleep(0.01)
        cluster.events.append("given up")

    async def announce() -> None:
        if fails:
            fails.pop()
            raise ValueError("the name is taken")
        cluster.events.append("announced")

    async def test() -> None:
        keeping = asyncio.ensure_future(member.watch(give_up, announce))
        await wait_for_soon(lambda: cluster.looks_done > 3)
        assert cluster.events == ["joined"]  # nothing is lost
        cluster.refuses = 2
        cluster.lost = True
        await wait_for_soon(lambda: "announced" in cluster.events)
        keeping.cancel()

    asyncio.run(test())
    assert cluster.events == ["joined", "given up", "left", "left", "left", "joined", "announced"]
    assert cluster.inits == 4


def test_a_silent_head_is_told_of_once_and_is_no_lost_node(
    cluster: LosableCluster, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answers = threading.Event()
    asked: list[bool] = []
    waits: list[float | None] = []
    real = asyncio.wait

    async def wait(answers: Any, *, timeout: float | None = None) -> Any:
        waits.append(timeout)
        return await real(answers, timeout=timeout)

    def ask() -> bool:
        asked.append(True)
        if len(asked) == 1:
            raise RuntimeError("no head")
        answers.wait(HANG_S)
        return False

    async def nothing() -> None:
        pass

    async def test() -> None:
        keeping = asyncio.ensure_future(member.watch(nothing, nothing))
        await wait_for_soon(lambda: len(asked) == 2 and waits[2:] == [0.02, None])  # in vain, and it waits on
        assert member._thread._work_queue.empty()  # one question at a time
        answers.set()
        await wait_for_soon(lambda: len(asked) > 3)
        keeping.cancel()

    monkeypatch.setattr(membership, "own_node_is_lost", ask)
    monkeypatch.setattr(membership, "SILENT_S", 0.02)
    member = membership.Membership(None)
    member.join()
    monkeypatch.setattr(membership.asyncio, "wait", wait)
    with caplog.at_level("INFO", "scas4d.server"):
        asyncio.run(test())
    told = [record.message for record in caplog.records]
    assert len([line for line in told if "does not respond" in line]) == 1
    assert told[-1] == "the Ray head node is responding again"
    assert cluster.events == ["joined"]


def test_a_service_that_ray_does_not_let_join_again_ends(
    cluster: LosableCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would stay without workers: its supervisor starts another, which finds all scenes in the data folder."""
    ended: list[int] = []
    stands_still = threading.Event()

    def end(code: int) -> None:
        ended.append(code)
        stands_still.set()

    async def nothing() -> None:
        pass

    async def test() -> None:
        cluster.lost = True
        keeping = asyncio.ensure_future(member.watch(nothing, nothing))
        await wait_for_soon(lambda: ended)
        keeping.cancel()

    member = membership.Membership(None)
    member.join()
    monkeypatch.setattr(membership, "JOIN_S", 0.05)
    monkeypatch.setattr(membership.os, "_exit", end)
    monkeypatch.setattr(membership.ray, "shutdown", lambda: stands_still.wait(HANG_S))
    asyncio.run(test())
    assert set(ended) == {1}


def test_a_node_that_is_lost_before_the_service_is_announced_is_noticed(cluster: LosableCluster) -> None:
    lost: list[bool] = []

    async def lose() -> None:
        lost.append(True)

    async def fails() -> None:
        raise ValueError("the name is taken")

    async def test() -> None:
        cluster.lost = True
        keeping = asyncio.ensure_future(member.watch(lose, fails))
        await wait_for_soon(lambda: cluster.events.count("joined") == 2)
        cluster.lost = True
        await wait_for_soon(lambda: cluster.events.count("joined") == 3)
        keeping.cancel()

    member = membership.Membership(None)
    member.join()
    asyncio.run(test())
    assert len(lost) == 2


def test_a_service_that_ray_does_not_let_leave_ends(cluster: LosableCluster, monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []
    stands_still = threading.Event()
    monkeypatch.setattr(membership, "LEAVE_S", 0.05)
    monkeypatch.setattr(membership.os, "_exit", ended.append)
    monkeypatch.setattr(membership.ray, "shutdown", lambda: stands_still.wait(HANG_S))
    membership.Membership(None).leave()
    stands_still.set()
    assert ended == [1]
