"""Calls of Ray: none begins while the service has left its cluster, and it leaves once those before are over."""

from __future__ import annotations

import asyncio
import concurrent.futures
import gc
import threading
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from waiting import HANG_S, wait_for_soon

from server.cluster.ray_calls import THREADS, RayCalls
from tests.server.cluster.others import others_have_called


def run(test: Callable[[RayCalls], Awaitable[None]]) -> None:
    async def all_of() -> None:
        calls = RayCalls()
        try:
            await test(calls)
        finally:
            calls.close()

    asyncio.run(all_of())


def test_what_is_asked_while_calls_are_held_begins_later_and_takes_no_thread() -> None:
    async def test(calls: RayCalls) -> None:
        calls.suspend()
        waiting = [calls.call(lambda: 1) for _ in range(10 * THREADS)]
        await others_have_called()
        assert await calls.wait(0)
        assert not any(call.done() for call in waiting)
        calls.resume()
        assert await asyncio.gather(*waiting) == [1] * len(waiting)

    run(test)


def test_what_waits_for_a_thread_when_calls_are_held_begins_later() -> None:
    async def test(calls: RayCalls) -> None:
        busy, called = threading.Event(), threading.Event()
        on = [calls.call(busy.wait, HANG_S) for _ in range(THREADS)]
        queued = calls.call(called.set)
        await wait_for_soon(lambda: len(calls.running) == THREADS + 1)
        calls.suspend()
        assert not await calls.wait(0)
        busy.set()
        await asyncio.gather(*on)
        assert await calls.wait(HANG_S)
        await others_have_called()
        assert not called.is_set()
        calls.resume()
        await queued
        assert called.is_set()

    run(test)


def test_a_fault_while_they_are_waited_for_is_told_to_who_has_asked_alone(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = threading.Event()

    def wait(*given: Any) -> Any:
        waits.set()
        return concurrent.futures.wait(*given)

    monkeypatch.setattr("server.cluster.ray_calls.wait", wait)

    async def test(calls: RayCalls) -> None:
        fails = threading.Event()

        def fail() -> None:
            fails.wait(HANG_S)
            raise ConnectionError("no head")

        call = calls.call(fail)
        await wait_for_soon(lambda: calls.running)
        waiting = asyncio.ensure_future(calls.wait(HANG_S))
        await wait_for_soon(waits.is_set)
        fails.set()
        assert await waiting
        with pytest.raises(ConnectionError):
            await call

    run(test)
    gc.collect()
    assert caplog.records == []


def test_one_that_is_cancelled_before_it_begins_is_never_called() -> None:
    called: list[int] = []

    async def test(calls: RayCalls) -> None:
        calls.suspend()
        held = calls.call(called.append, 1)
        await asyncio.sleep(0)
        held.cancel()
        calls.resume()
        await calls.call(called.append, 2)
        busy = threading.Event()
        on = [calls.call(busy.wait, HANG_S) for _ in range(THREADS)]
        queued = calls.call(called.append, 3)
        await wait_for_soon(lambda: len(calls.running) == THREADS + 1)
        queued.cancel()
        await asyncio.sleep(0)
        busy.set()
        await asyncio.gather(*on)

    run(test)
    assert called == [2]


@pytest.mark.parametrize("cancelled", [False, True])
def test_those_that_have_begun_are_waited_for_also_where_nobody_else_does(*, cancelled: bool) -> None:
    async def test(calls: RayCalls) -> None:
        ends = threading.Event()
        call = calls.call(ends.wait, HANG_S)
        await wait_for_soon(lambda: calls.running and next(iter(calls.running)).running())
        if cancelled:
            call.cancel()
            await asyncio.sleep(0)
        calls.suspend()
        assert not await calls.wait(0.05)
        ends.set()
        assert await calls.wait(HANG_S)
        assert await calls.wait(0)

    run(test)


def test_a_fault_reaches_who_has_asked() -> None:
    async def test(calls: RayCalls) -> None:
        with pytest.raises(ZeroDivisionError):
            await calls.call(lambda: 1 // 0)

    run(test)
