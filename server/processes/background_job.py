"""Background jobs of a scene, such as an export: one process at low priority that reports how it ended."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, NoReturn

from server.messages import JobEnded
from server.processes.placement import Entry, Placement, ProcessExit, end_with_parent

NICE = 15
"""Niceness increment of the process, which leaves it about a tenth of a core shared with a scene's worker."""


def run_job(job: Callable[[], None], connection: Connection[Any, Any], explain: Callable[[Exception], str]) -> NoReturn:
    """Runs a job in its process, sends the outcome, and exits once the service asks the process to stop.

    Exiting earlier would be treated as a crash.

    Args:
        job: the job.
        connection: connection to the service.
        explain: logs an error of the job, and returns the user-facing explanation.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the service decides when to stop
    os.nice(NICE)
    end_with_parent()
    fault: str | None = None
    try:
        job()
    except Exception as error:  # any failure in the core must be reported, and the service must keep running
        fault = explain(error)
    with contextlib.suppress(EOFError, OSError):  # the service is gone
        connection.send(JobEnded(fault))
        logging.shutdown()
        connection.recv()
    os._exit(0)


async def wait_for_job(
    placement: Placement, entry: Entry, spec: Any, on_message: Callable[[Any], None], name: str
) -> str | None:
    """Runs the process of a job, and stops it at the end or when this call is cancelled.

    Args:
        placement: placement that starts the process.
        entry, spec: entry point of the process and its argument.
        on_message: callback for every other message of the process, until the job has ended or was cancelled.
        name: name of the job in error messages.

    Returns:
        The reason why the job failed, or None.
    """
    ended: asyncio.Future[str | None] = asyncio.get_running_loop().create_future()

    def end(fault: str | None) -> None:
        if not ended.done():
            ended.set_result(fault)

    def receive(message: Any) -> None:
        if isinstance(message, JobEnded):
            end(message.fault)
        elif not ended.done():
            on_message(message)

    def gone(reason: ProcessExit) -> None:
        end(f"the {name} process exited unexpectedly ({reason})")

    process = placement.start(entry, spec, receive, gone)
    try:
        return await ended
    finally:
        await asyncio.shield(process.stop(1.0 if ended.done() and not ended.cancelled() else 0))
