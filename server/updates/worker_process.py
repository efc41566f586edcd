"""Supervision of a scene's worker process: starts it, counts its crashes and restarts it.

The cause of a crash, internal or external, determines when the worker is restarted and when the frame fails.
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
from server.processes.placement import Placement, ProcessExit, ProcessHandle
from server.storage.events import FrameFailed, WorkerDied
from server.storage.fencing import FencingError, begin_epoch, remove_earlier_epochs
from server.storage.frame_table import FrameEntry

log = logging.getLogger("scas4d.server")

OWN_SIGNALS = frozenset(
    {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSYS, signal.SIGTRAP}
)
OWN_DEATHS = 2
"""Number of crashes caused by the worker itself after which the frame fails."""
OTHER_DEATHS = 6
"""Number of external kills after which the frame fails, because it is probably the cause."""
FIRST_DELAY_S, LONGEST_DELAY_S = 0.5, 30.0

MAX_FREE_LOSSES = 3
"""Number of consecutive machine losses before the restart delay grows, in case the frame brings machines down."""
MAX_WAIT_AFTER_LOSS_S = 8.0
"""Maximum restart delay in seconds after a machine loss, so that the scene recovers within half a minute."""

SWEEP_AFTER_S = 120.0
"""Time in seconds that an abandoned worker's states are kept, since NFS may cache the old link for up to a minute."""


class WorkerDeaths:
    """Counter of crashes of one scene's worker."""

    def __init__(self) -> None:
        self.count = 0
        self._in_a_row = self._lost_in_a_row = 0
        self._oom_kills = oom_kills()

    @property
    def in_a_row(self) -> int:
        """Number of crashes and machine losses since the last commit."""
        return self._in_a_row + self._lost_in_a_row

    def note_start(self) -> None:
        """Records a start of the worker."""
        self._oom_kills = oom_kills()

    def note_commit(self) -> None:
        """Records a commit, which proves that the worker is functional and resets the restart delays."""
        self._in_a_row = self._lost_in_a_row = 0

    def note_death(self, why: ProcessExit) -> tuple[bool, float]:
        """Records an exit of the worker process; the restart delay is shorter if its machine was lost.

        Returns:
            Whether the worker itself caused the exit, and the restart delay in seconds. The worker is the cause
            if it exited with an error, crashed (for example with SIGSEGV) or ran out of memory.
        """
        own = why.exit_code is not None and (why.exit_code > 0 or -why.exit_code in OWN_SIGNALS)
        own = own or (oom_kills() > self._oom_kills if why.out_of_memory is None else why.out_of_memory)
        self.count += 1
        if why.lost:
            self._lost_in_a_row += 1
            times = max(0, self._lost_in_a_row - MAX_FREE_LOSSES)
            return False, min(MAX_WAIT_AFTER_LOSS_S, FIRST_DELAY_S * 2**times)
        delay = min(LONGEST_DELAY_S, FIRST_DELAY_S * 2**self._in_a_row)
        self._in_a_row += 1
        return own, delay


def give_up_event(entry: FrameEntry, death: WorkerDied) -> FrameFailed | None:
    """Returns the event that fails the frame after a crash that `entry` already counts, or None to retry the frame."""
    own, other = entry.rare_properties.own_deaths, entry.rare_properties.other_deaths
    if own >= OWN_DEATHS:
        reason = f"the worker crashed {own} times while reconstructing this frame (last: {death.reason})"
    elif other >= OTHER_DEATHS:
        reason = f"the worker was killed {other} times while reconstructing this frame (last: {death.reason})"
    else:
        return None
    return FrameFailed(index=death.index, reason=reason)


class WorkerProcess:
    """Supervisor of at most one worker process at a time. All methods run on the event loop.

    Args:
        spec: scene specification; a change takes effect at the next start.
        placement: placement used to start the process.

    Attributes:
        ready: whether the process has loaded the scene; set by the receiver of its `Ready` message.
        life: identity of the running process, or None if there is none.
        deaths: counter of worker crashes.
    """

    def __init__(self, spec: SceneSpec, placement: Placement) -> None:
        self.spec = spec
        self.ready = False
        self.life: object | None = None
        self.deaths = WorkerDeaths()
        self._placement = placement
        self._received: Callable[[Any], None]
        self._ended: Callable[[ProcessExit], None]
        self._process: ProcessHandle | None = None
        self._next: asyncio.TimerHandle | None = None
        self._closed = False
        self._ends = False
        """Whether the process has exited and `start_in` has not been called yet."""
        self._epoch: int | None = None
        self._fencing: asyncio.Task[None] | None = None
        """Task that starts an epoch for the next process."""

    def listen(self, received: Callable[[Any], None], ended: Callable[[ProcessExit], None]) -> None:
        """Sets the callbacks; call this once, before the first start.

        Args:
            received: callback that receives every message from the process.
            ended: callback for an unexpected exit of the process; it must call `start_in` to start the next process.
        """
        self._received, self._ended = received, ended

    @property
    def starts_again(self) -> bool:
        """Whether a restart is scheduled after a crash."""
        return self._next is not None

    def start(self) -> None:
        """Starts the process unless it is running, already starting, or the supervisor is closed."""
        if not (self._process or self._fencing or self._next or self._ends or self._closed):
            # With epochs, a worker on another machine may still be running although it was presumed dead.
            if self._placement.fenced or self.spec.folder.states.is_symlink():
                self._fencing = asyncio.get_running_loop().create_task(self._start_fenced())
            else:
                self._start(self.spec)

    async def _start_fenced(self) -> None:
        """Starts the process with its own epoch; a failure to start the epoch is handled like a process exit."""
        folder = self.spec.folder
        try:
            epoch = await asyncio.to_thread(begin_epoch, folder.states, folder.worker_lock)
            if not self._closed:
                self._start(replace(self.spec, folder=replace(folder, epoch=epoch)))
        except Exception as error:  # any error must be handled, so that the scene retries
            if not isinstance(error, OSError | FencingError):
                log.exception("scene %s", folder.name)
            self._on_end(ProcessExit(None, f"cannot take over the committed states: {message_of(error)}"))
        finally:
            self._fencing = None

    def _start(self, spec: SceneSpec) -> None:
        self.deaths.note_start()
        self.life = object()
        self._epoch = spec.folder.epoch
        self._process = self._placement.start(worker.main, spec, self._received, self._on_end)

    async def remove_earlier_epochs(self) -> None:
        """Removes the states of earlier workers after a delay that gives readers time to notice the new link."""
        if (epoch := self._epoch) is None:
            return
        await asyncio.sleep(SWEEP_AFTER_S)
        if names := await asyncio.to_thread(remove_earlier_epochs, self.spec.folder.states, epoch):
            log.info("scene %s: removed folders of earlier workers: %s", self.spec.folder.name, ", ".join(names))

    def start_in(self, seconds: float) -> None:
        """Schedules the start of the next process; call this after every unexpected exit."""
        self._ends = False
        if not self._closed:
            self._next = asyncio.get_running_loop().call_later(seconds, self._restart)

    def send(self, message: Any) -> bool:
        """Sends a message to the process if it is ready; otherwise starts the process and returns False."""
        if self.ready and self._process is not None:
            self._process.send(message)
            return True
        self.start()
        return False

    def close(self) -> None:
        """Cancels any scheduled start and prevents further ones."""
        self._closed = True
        if self._next is not None:
            self._next.cancel()

    async def stop(self, seconds: float) -> None:
        """Stops the process, killing it after `seconds`; the next process repeats an unfinished frame."""
        if self._fencing is not None:
            await asyncio.wait({self._fencing})  # a thread is changing the folder, which may be deleted next
        if self._process is not None:
            await self._process.stop(seconds)

    def _restart(self) -> None:
        self._next = None
        self.start()

    def _on_end(self, reason: ProcessExit) -> None:
        self.ready, self.life, self._process = False, None, None
        if not self._closed:
            self._ends = True
            self._ended(reason)
