"""Runs measurements in a separate process, so that memory and caches from earlier work do not affect them."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any


def in_a_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Calls a module-level function in a new process and returns its result, or raises its exception.

    Raises:
        BrokenProcessPool: the process ended before it returned a result, for example because it ran out of memory.
    """
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as apart:
        return apart.submit(function, *arguments).result()
