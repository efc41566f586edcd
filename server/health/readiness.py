"""Readiness of the service: a process beside it has the kernels compiled that the cache lacks.

The service is ready once those of a first frame are compiled; those of updates follow while frame 0 runs. The process
that answers requests never loads them. Workers find the compiled kernels in the cache, and wait for those of updates.
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
from server.messages import Stop
from server.problems import Problem
from server.processes.placement import AnyProcess, Placement, end_with_parent
from server.settings import ServerSettings

log = logging.getLogger("scas4d.server")

SAY_S = 5.0
"""Between two lines of the log on how many kernels are compiled."""


@dataclass(frozen=True)
class Compiled:
    """So many of the kernels of a first frame are compiled."""

    done: int
    total: int


@dataclass(frozen=True)
class WarmedUp:
    """The kernels of a first frame are compiled; or not, for the reason in `fault`."""

    fault: str | None = None


def main(spec: None, connection: Connection[Any, Any]) -> None:
    """Runs the process: it warms up, reports, has the kernels of updates compiled, and ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    with contextlib.suppress(EOFError, OSError):
        try:
            from scas4d_core.warm_up import warm_up, warm_up_updates  # in this process only: the service stays light

            warm_up(lambda done, total: connection.send(Compiled(done, total)))
            connection.send(WarmedUp())
            warm_up_updates()
        except (EOFError, OSError):
            raise
        except Exception as error:
            log.exception("the kernels could not be warmed up")
            connection.send(WarmedUp(f"{type(error).__name__}: {message_of(error)}"))
        connection.recv()  # until it is asked to end, or until the service is gone: by then the report is read
    os._exit(0)


class Readiness:
    """Warms up the kernels from the start of the service on.

    Attributes:
        after: seconds from the start to being ready; None: not yet.
        fault: why the kernels could not be warmed up. The service works without, its first frame says what is wrong.
        compiled: how many kernels of a first frame are compiled, and of how many; None: not known, or all were.
        stopping: the service ends.
    """

    def __init__(self, settings: ServerSettings, placement: Placement) -> None:
        self._began = time.monotonic()
        self.after: float | None = None
        self.fault: str | None = None
        self.stopping = False
        self.compiled: Compiled | None = None
        self._said = self._began
        self._process: AnyProcess | None = None
        if settings.warm_up:
            log.info("warming up the kernels; the first time they are compiled, which takes half a minute")
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
            now = self.compiled
            more: dict[str, Any] = {} if now is None else {"kernels_compiled": now.done, "kernels": now.total}
            so_far = "" if now is None else f": {now.done} of {now.total}"
            raise Problem(
                503,
                f"kernels are being warmed up, for {waited:.1f} s so far; the first time they are compiled{so_far}",
                remedy="ask again",
                headers={"Retry-After": "1"},
                seconds=waited,
                warming_up=True,
                **more,
            )
        return self.after

    async def stop(self) -> None:
        """Ends the process."""
        self.stopping = True
        if self._process is not None:
            process, self._process = self._process, None
            await process.stop(0.0)  # it compiles, or has nothing left to do

    def _received(self, message: Compiled | WarmedUp) -> None:
        if isinstance(message, Compiled):
            self.compiled = message
            if (now := time.monotonic()) - self._said >= SAY_S:
                self._said = now
                log.info("compiling kernels: %d of %d", message.done, message.total)
            return
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
