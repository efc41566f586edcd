"""Compilation of the kernels that a worker's next frame needs, with progress reports."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from scas4d_core.settings import Settings
from server.messages import Progressed

STAGE = "compiling kernels"
"""Name of the stage reported while a worker waits for kernels to be compiled."""

Send = Callable[[Any], None]

log = logging.getLogger("scas4d.worker")


def wait_for_first(settings: Settings, points: bool, send: Send) -> float:
    """Waits until the first frame's kernels are compiled and returns the time waited in seconds.

    The kernels of updates are compiled afterwards, while the first frame is being reconstructed.

    Args:
        settings: settings of the scene.
        points: whether the scene has an initial point cloud.
        send: function that sends a message with the progress.
    """
    from scas4d_core import warm_up  # imported lazily: the service process does not need the core

    first, updates = warm_up.first_frame_groups(points=points), warm_up.update_groups(settings.update.covariance)
    return _waited(first, send, then=updates)


def wait_for_updates(settings: Settings, send: Send | None) -> float:
    """Waits until the update and rendering kernels are compiled and returns the time waited in seconds.

    Args:
        settings: settings of the scene.
        send: function that sends a message with the progress, or None to send none.
    """
    from scas4d_core import warm_up

    groups = (*warm_up.first_frame_groups(points=True), *warm_up.update_groups(settings.update.covariance))
    return _waited(groups, send)


def _waited(groups: tuple[Any, ...], send: Send | None, **more: Any) -> float:
    from scas4d_core.warm_up import compile_in_processes

    began = time.perf_counter()

    def report_progress(done: int, total: int) -> None:
        log.info("compiling kernels: %d of %d", done, total)
        if send is not None:
            send(Progressed(STAGE, done, total, {}))

    compile_in_processes(groups, on_progress=report_progress, **more)
    return time.perf_counter() - began
