"""Waiting in tests: one limit, for what hangs, and nothing else in a test depends on how fast the machine is."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

HANG_S = 300.0
"""Whatever takes longer hangs: many times what anything here takes on a slow machine with other work."""


class Hand:
    """A clock that is set by hand."""

    def __init__(self, at=0.0):
        self.at = at

    def __call__(self):
        return self.at


def wait_for(condition: Callable[[], object]) -> None:
    """Returns once a condition holds."""
    until = time.monotonic() + HANG_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


async def wait_for_soon(condition: Callable[[], object]) -> None:
    """The same beside an event loop."""
    until = time.monotonic() + HANG_S
    while not condition():
        assert time.monotonic() < until
        await asyncio.sleep(0.01)
