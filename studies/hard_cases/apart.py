"""A measurement in a process of its own, so that its memory is not that of earlier work."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from typing import Any


def in_a_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a function of a module in a fresh process; returns its result."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)
