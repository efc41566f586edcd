"""The virtual clock of the tests: it jumps to the next timer, uses no threads, and notices a standstill."""

from __future__ import annotations

import asyncio
import threading

import pytest
from virtual_clock import StandstillError, run_virtual


def test_the_clock_jumps_to_the_next_timer() -> None:
    async def main() -> list[tuple[float, str]]:
        loop, found = asyncio.get_running_loop(), []

        async def wait(seconds: float, name: str) -> None:
            await asyncio.sleep(seconds)
            found.append((loop.time(), name))

        await asyncio.gather(wait(3600, "b"), wait(60, "a"), wait(86_400 * 3, "c"))
        return found

    assert run_virtual(main()) == [(60, "a"), (3600, "b"), (86_400 * 3, "c")]


def test_blocking_functions_run_in_the_same_thread() -> None:
    async def main() -> tuple[int, float]:
        found = await asyncio.to_thread(threading.get_ident)
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 // 0)
        return found, asyncio.get_running_loop().time()

    assert run_virtual(main()) == (threading.get_ident(), 0.0)


def test_a_standstill_is_an_error() -> None:
    async def main() -> None:
        await asyncio.get_running_loop().create_future()

    with pytest.raises(StandstillError):
        run_virtual(main())
