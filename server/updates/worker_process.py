"""Supervises a scene's worker process: starts it, counts its deaths, starts it again.

A death is the worker's own doing or not; that decides when it is started again and when a frame is given up.
"""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from scas4d_core.errors import message_of
from server.health.oom import oom_kills
from server.messages import SceneSpec
from server.processes import worker
from server.processes.placement import AnyProcess, Placement, ProcessExit
from server.storage.events import FrameFailed, WorkerDied
from server.storage.fencing import FencingError, begin_epoch, sweep
from server.storage.frame_table import FrameEntry

log = logging.getLogger("scas4d.server")

OWN_SIGNALS = frozenset(
    {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSYS, signal.SIGTRAP}
)
OWN_DEATHS = 2
"""Deaths of the worker, by its own doing, after which a frame fails."""
OTHER_DEATHS = 6
"""Deaths from outside after which a frame fails, too: something is wrong with it all the same."""
FIRST_DELAY_S, LONGEST_DELAY_S = 0.5, 30.0

LOST_AT_ONCE = 3
"""Machines that are lost one after another without a pause; a frame may be what takes them down."""
LONGEST_AFTER_LOST_S = 8.0
"""The pause then: a scene whose machines go for other reasons goes on within half a minute."""

SWEEP_AFTER_S = 120.0
"""The states of a worker that was given up are kept for so long: NFS shows a link as it was for up to a minute."""


class WorkerDeaths:
    """Counts the deaths of one scene's worker."""

    def __init__(self) -> None:
        self.count = 0
        self._in_a_row = self._lost_in_a_row = 0
        self._oom_kills = oom_kills()

    def started(self) -> None:
        """Notes that the worker is started."""
        self._oom_kills = oom_kills()

    def committed(self) -> None:
        """Notes that the worker works: it has committed a frame."""
        self._in_a_row = self._lost_in_a_row = 0

    def died(self, why: ProcessExit) -> tuple[bool, float]:
        """Notes that the worker is gone; where it is with its machine, another one is waited for less.

        Returns:
            True where it died by its own doing (it exited, or by a signal that only a fault of its own sends, or it was
            killed for want of memory); and the seconds to wait before it is started again.
        """
        own = why.exit_code is not None and (why.exit_code > 0 or -why.exit_code in OWN_SIGNALS)
        own = own or (oom_kills() > self._oom_kills if why.starved is None else why.starved)
        self.count += 1
        if why.lost:
            self._lost_in_a_row += 1
            times = max(0, self._lost_in_a_row - LOST_AT_ONCE)
            return False, min(LONGEST_AFTER_LOST_S, FIRST_DELAY_S * 2**times)
        delay = min(LONGEST_DELAY_S, FIRST_DELAY_S * 2**self._in_a_row)
        self._in_a_row += 1
        return own, delay


def given_up(entry: FrameEntry, death: WorkerDied) -> FrameFailed | None:
    """Returns the event that fails the frame for this death, which is counted already; None: it is tried again."""
    own, other = entry.note.own_deaths, entry.note.other_deaths
    if own >= OWN_DEATHS:
        reason = f"the worker died {own} times while it reconstructed this frame: {death.reason}"
    elif other >= OTHER_DEATHS:
        reason = f"the worker was killed {other} times while it reconstructed this frame: {death.reason}"
    else:
        return None
    return FrameFailed(index=death.index, reason=reason)


class WorkerProcess:
    """At most one process at a time. On the event loop.

    Args:
        spec: of the scene; another one holds from the next start on.
        placement: starts the process.

    Attributes:
        ready: the process has said that it has taken the scene up; to be set by who receives that message.
        life: of the process, another each time; None without one.
        deaths: how often a process died, and whether by its own doing.
    """

    def __init__(self, spec: SceneSpec, placement: Placement) -> None:
        self.spec = spec
        self.ready = False
        self.life: object | None = None
        self.deaths = WorkerDeaths()
        self._placement = placement
        self._received: Callable[[Any], None]
        self._ended: Callable[[ProcessExit], None]
        self._process: AnyProcess | None = None
        self._next: asyncio.TimerHandle | None = None
        self._closed = False
        self._ends = False
        """It has ended, and when the next starts is not said yet."""
        self._epoch: int | None = None
        self._fencing: asyncio.Task[None] | None = None
        """Begins an epoch for the next process."""

    def listen(self, received: Callable[[Any], None], ended: Callable[[ProcessExit], None]) -> None:
        """Sets the receiver of messages; to be called once, before the first start.

        Args:
            received: called with every message of the process.
            ended: called when the process ended without being asked to; `start_in` starts the next.
        """
        self._received, self._ended = received, ended

    @property
    def starts_again(self) -> bool:
        """True between a death and the next start."""
        return self._next is not None

    def start(self) -> None:
        """Starts the process, unless it runs, is about to, or the scene ends."""
        if not (self._process or self._fencing or self._next or self._ends or self._closed):
            # Once a folder has epochs, a worker on another machine may go on that was taken for dead.
            if self._placement.fenced or self.spec.folder.states.is_symlink():
                self._fencing = asyncio.get_running_loop().create_task(self._start_fenced())
            else:
                self._start(self.spec)

    async def _start_fenced(self) -> None:
        """Starts the process with an epoch of its own; that it cannot begin is as if the process had ended."""
        folder = self.spec.folder
        try:
            epoch = await asyncio.to_thread(begin_epoch, folder.states, folder.worker_lock)
            if not self._closed:
                self._start(replace(self.spec, folder=replace(folder, epoch=epoch)))
        except Exception as error:  # whatever it is, the scene must not stand still
            if not isinstance(error, OSError | FencingError):
                log.exception("scene %s", folder.name)
            self._gone(ProcessExit(None, f"the committed states cannot be taken over: {message_of(error)}"))
        finally:
            self._fencing = None

    def _start(self, spec: SceneSpec) -> None:
        self.deaths.started()
        self.life = object()
        self._epoch = spec.folder.epoch
        self._process = self._placement.start(worker.main, spec, self._received, self._gone)

    async def sweep(self) -> None:
        """Removes the states of workers before, once readers through an old link have seen the new one."""
        if (epoch := self._epoch) is None:
            return
        await asyncio.sleep(SWEEP_AFTER_S)
        if names := await asyncio.to_thread(sweep, self.spec.folder.states, epoch):
            log.info("scene %s: removed %s, of workers before", self.spec.folder.name, ", ".join(names))

    def start_in(self, seconds: float) -> None:
        """Starts the next process after so long; to be called at each end."""
        self._ends = False
        if not self._closed:
            self._next = asyncio.get_running_loop().call_later(seconds, self._again)

    def send(self, message: Any) -> bool:
        """Posts a message to a process that is ready; starts one and returns False where there is none."""
        if self.ready and self._process is not None:
            self._process.send(message)
            return True
        self.start()
        return False

    def close(self) -> None:
        """Starts no process any more."""
        self._closed = True
        if self._next is not None:
            self._next.cancel()

    async def stop(self, seconds: float) -> None:
        """Ends the process, which has `seconds` to do so itself; an unfinished frame is updated again by the next."""
        if self._fencing is not None:
            await asyncio.wait({self._fencing})  # a thread changes the folder, which may be deleted next
        if self._process is not None:
            await self._process.stop(seconds)

    def _again(self) -> None:
        self._next = None
        self.start()

    def _gone(self, reason: ProcessExit) -> None:
        self.ready, self.life, self._process = False, None, None
        if not self._closed:
            self._ends = True
            self._ended(reason)
