"""Readiness of the service: a process beside it compiles the kernels, or loads them from the cache.

The process that answers requests never loads them. Workers find the compiled kernels in the cache.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from scas4d_core.errors import message_of
from server.problems import Problem
from server.processes.messages import Stop
from server.processes.placement import Placement, Process
from server.settings import ServerSettings

log = logging.getLogger("scas4d.server")

ENDS_S = 2.0


@dataclass(frozen=True)
class WarmedUp:
    """The kernels are compiled; or not, for the reason in `fault`."""

    fault: str | None = None


def main(spec: None, connection: Connection[Any, Any]) -> None:
    """Runs the process: it warms up, reports, and ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        from scas4d_core.warm_up import warm_up  # in this process only: the service stays light

        warm_up()
        found = WarmedUp()
    except Exception as error:
        log.exception("the kernels could not be warmed up")
        found = WarmedUp(f"{type(error).__name__}: {message_of(error)}")
    with contextlib.suppress(EOFError, OSError):
        connection.send(found)
        connection.recv()  # until it is asked to end, or until the service is gone: by then the report is read
    os._exit(0)


class Readiness:
    """Warms up the kernels from the start of the service on.

    Attributes:
        after: seconds from the start to being ready; None: not yet.
        fault: why the kernels could not be warmed up. The service works without, its first frame says what is wrong.
        stopping: the service ends.
    """

    def __init__(self, settings: ServerSettings, placement: Placement) -> None:
        self._began = time.monotonic()
        self.after: float | None = None
        self.fault: str | None = None
        self.stopping = False
        self._process: Process | None = None
        if settings.warm_up:
            log.info("warming up the kernels; the first time they are compiled, which takes about a minute")
            self._process = placement.start(main, None, self._received, self._ended)
        else:
            self.after = 0.0

    def check(self) -> float:
        """Returns the seconds from the start until the service was ready.

        Raises:
            Problem: 503, not ready; `warming_up` says that it will be, without anybody's doing.
        """
        waited = time.monotonic() - self._began
        if self.stopping:
            raise Problem(503, "the service ends", remedy="wait until it is started again", seconds=waited)
        if self.fault is not None:
            raise Problem(
                503,
                f"the kernels could not be warmed up: {self.fault}",
                remedy="the service's log has the traceback; SCAS4D_WARM_UP=false starts without",
                seconds=waited,
            )
        if self.after is None:
            raise Problem(
                503,
                f"kernels are being warmed up, for {waited:.1f} s so far; the first time they are compiled",
                remedy="ask again",
                headers={"Retry-After": "1"},
                seconds=waited,
                warming_up=True,
            )
        return self.after

    async def stop(self) -> None:
        """Ends the process."""
        self.stopping = True
        if self._process is not None:
            process, self._process = self._process, None
            await process.stop(0.0 if self.after is None else ENDS_S)

    def _received(self, message: WarmedUp) -> None:
        if message.fault is None:
            self.after = time.monotonic() - self._began
            log.info("ready after %.1f s", self.after, extra={"ready_after": round(self.after, 3)})
        self.fault = message.fault
        if self._process is not None:
            self._process.send(Stop())

    def _ended(self, how: str) -> None:
        self._process = None
        if self.after is None and self.fault is None:
            self.fault = str(how)
            log.error("the kernels could not be warmed up: %s", self.fault)
