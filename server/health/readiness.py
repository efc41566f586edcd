"""Readiness of the service, which depends on the compilation of its kernels.

A separate process compiles the kernels that are not in the cache. The service is ready as soon as
the kernels for a first frame are compiled. The kernels for updates are compiled after that. The
process that handles requests never loads the kernels. Workers load the kernels from the cache, and
wait for the kernels of updates if necessary.
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
from server.processes.placement import Placement, ProcessHandle, end_with_parent
from server.settings import ServerSettings

log = logging.getLogger("scas4d.server")

LOG_S = 5.0
"""Interval in seconds between log lines about the compilation progress."""


@dataclass(frozen=True)
class CompileProgress:
    """Progress of the compilation: `done` of `total` kernels for a first frame have been compiled."""

    done: int
    total: int


@dataclass(frozen=True)
class WarmUpResult:
    """Result of compiling the kernels for a first frame; `fault` is the reason for a failure, or None."""

    fault: str | None = None


def main(spec: None, connection: Connection[Any, Any]) -> None:
    """Entry point of the process: compiles the first-frame kernels, reports the result, and compiles the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    with contextlib.suppress(EOFError, OSError):
        try:
            from scas4d_core.warm_up import warm_up, warm_up_updates  # imported lazily: keeps the service process small

            warm_up(lambda done, total: connection.send(CompileProgress(done, total)))
            connection.send(WarmUpResult())
            warm_up_updates()
        except (EOFError, OSError):
            raise
        except Exception as error:
            log.exception("cannot compile the kernels")
            connection.send(WarmUpResult(f"{type(error).__name__}: {message_of(error)}"))
        connection.recv()  # returns when asked to exit or when the service is gone; by then, the result was read
    os._exit(0)


class Readiness:
    """Readiness of the service; creating an instance starts the warm-up of the kernels.

    Attributes:
        after: startup time of the service in seconds; None if it is not ready yet.
        fault: reason why the kernels could not be compiled, or None. The service continues without the warm-up, and
            its first frame reports the error.
        compiled: progress of the compilation of the kernels for a first frame; None if unknown.
        stopping: whether the service is shutting down.
    """

    def __init__(self, settings: ServerSettings, placement: Placement) -> None:
        self._began = time.monotonic()
        self.after: float | None = None
        self.fault: str | None = None
        self.stopping = False
        self.compiled: CompileProgress | None = None
        self._logged_at = self._began
        self._process: ProcessHandle | None = None
        if settings.warm_up:
            log.info("loading the kernels; they are compiled on the first start, which takes about half a minute")
            self._process = placement.start(main, None, self._on_message, self._on_end)
        else:
            self.after = 0.0

    def check(self) -> float:
        """Returns the startup time of the service in seconds.

        Raises:
            Problem: 503 if the service is not ready; `warming_up` is true if it will become ready on its own.
        """
        waited = time.monotonic() - self._began
        if self.stopping:
            raise Problem(503, "the service is shutting down", remedy="retry after it has restarted", seconds=waited)
        if self.fault is not None:
            raise Problem(
                503,
                f"the kernels could not be compiled: {self.fault}",
                remedy="see the traceback in the service log; set SCAS4D_WARM_UP=false to skip the compilation",
                seconds=waited,
            )
        if self.after is None:
            now = self.compiled
            more: dict[str, Any] = {} if now is None else {"kernels_compiled": now.done, "kernels": now.total}
            so_far = "" if now is None else f" ({now.done} of {now.total} done)"
            raise Problem(
                503,
                f"the kernels have been loading for {waited:.1f} s; they are compiled on the first start{so_far}",
                remedy="try again later",
                headers={"Retry-After": "1"},
                seconds=waited,
                warming_up=True,
                **more,
            )
        return self.after

    async def stop(self) -> None:
        """Stops the process that compiles the kernels."""
        self.stopping = True
        if self._process is not None:
            process, self._process = self._process, None
            await process.stop(0.0)  # no grace period: the process has no data to save

    def _on_message(self, message: CompileProgress | WarmUpResult) -> None:
        if isinstance(message, CompileProgress):
            self.compiled = message
            if (now := time.monotonic()) - self._logged_at >= LOG_S:
                self._logged_at = now
                log.info("compiling kernels: %d of %d", message.done, message.total)
            return
        if message.fault is None:
            self.after = time.monotonic() - self._began
            log.info("ready after %.1f s", self.after, extra={"ready_after": round(self.after, 3)})
        self.fault = message.fault
        if self._process is not None:
            self._process.send(Stop())

    def _on_end(self, how: str) -> None:
        self._process = None
        if self.after is None and self.fault is None:
            self.fault = str(how)
            log.error("cannot compile the kernels: %s", self.fault)
