"""Time that the main thread of a page has run, from Chromium's own counters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def main_thread_clock(page: Any) -> Callable[[], float]:
    """Returns a function that returns the milliseconds that a page's main thread has run.

    Args:
        page: Playwright page in Chromium.
    """
    devtools = page.context.new_cdp_session(page)
    devtools.send("Performance.enable", {"timeDomain": "threadTicks"})

    def clock() -> float:
        metrics = devtools.send("Performance.getMetrics")["metrics"]
        return float(1e3 * next(one["value"] for one in metrics if one["name"] == "TaskDuration"))

    return clock
