"""A worker waits here until the kernels that its next frame needs are compiled, and says so."""

from __future__ import annotations

import logging
import time
from multiprocessing.connection import Connection
from typing import Any

from scas4d_core.settings import Settings
from server.messages import Progressed

STAGE = "compiling kernels"
"""The stage of a frame's progress, while its worker waits for them."""

log = logging.getLogger("scas4d.worker")


def wait_for_first(settings: Settings, points: bool, connection: Connection[Any, Any]) -> float:
    """Waits for the kernels of a first frame; those of updates are compiled after them, while it is fitted.

    Args:
        points: whether the scene was given points to start from. connection: is sent the progress.

    Returns:
        Seconds waited.
    """
    from scas4d_core import warm_up  # in this process only: the service stays light

    first, updates = warm_up.first_frame_groups(points=points), warm_up.update_groups(settings.update.covariance)
    return _waited(first, connection, then=updates)


def wait_for_updates(settings: Settings, connection: Connection[Any, Any] | None) -> float:
    """Waits for the kernels of updates and of the views in them; returns the seconds waited.

    Args:
        connection: is sent the progress; None: nothing is.
    """
    from scas4d_core import warm_up

    groups = (*warm_up.first_frame_groups(points=True), *warm_up.update_groups(settings.update.covariance))
    return _waited(groups, connection)


def _waited(groups: tuple[Any, ...], connection: Connection[Any, Any] | None, **more: Any) -> float:
    from scas4d_core.warm_up import compile_in_processes

    began = time.perf_counter()

    def report_progress(done: int, total: int) -> None:
        log.info("compiling kernels: %d of %d", done, total)
        if connection is not None:
            connection.send(Progressed(STAGE, done, total, {}))

    compile_in_processes(groups, on_progress=report_progress, **more)
    return time.perf_counter() - began
