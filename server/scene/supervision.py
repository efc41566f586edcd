"""Deaths of a scene's worker: whose doing they were, when it is started again, and when a frame is given up."""

from __future__ import annotations

import signal
from pathlib import Path

from server.storage.events import FrameSetAside, WorkerDied
from server.storage.frame_table import FrameEntry

OWN_SIGNALS = frozenset(
    {signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSYS, signal.SIGTRAP}
)
OWN_DEATHS = 2
"""A frame at which the worker died so often by its own doing is set aside."""
OTHER_DEATHS = 6
"""And one at which it was killed so often from outside: something is wrong with it all the same."""
FIRST_DELAY_S, LONGEST_DELAY_S = 0.5, 30.0


def oom_kills() -> int:
    """How many processes the kernel has killed for want of memory in the control group of this one."""
    try:
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            number, _, path = line.partition("::")
            if number == "0":
                events = Path("/sys/fs/cgroup") / path.lstrip("/") / "memory.events"
                counts = dict(pair.split() for pair in events.read_text().splitlines())
                return int(counts.get("oom_kill", 0))
    except (OSError, ValueError):  # no control groups here
        pass
    return 0


class Supervision:
    """Counts the deaths of one scene's worker."""

    def __init__(self) -> None:
        self.deaths = 0
        self._in_a_row = 0
        self._oom_kills = oom_kills()

    def started(self) -> None:
        """The worker is started."""
        self._oom_kills = oom_kills()

    def committed(self) -> None:
        """It works."""
        self._in_a_row = 0

    def died(self, exit_code: int | None) -> tuple[bool, float]:
        """The worker is gone.

        Returns:
            Whether it died through its own doing: it exited, by a signal that only a fault of its own sends, or it was
            killed for want of memory. And the seconds to wait before it is started again.
        """
        own = exit_code is not None and (exit_code > 0 or -exit_code in OWN_SIGNALS)
        own = own or oom_kills() > self._oom_kills
        delay = min(LONGEST_DELAY_S, FIRST_DELAY_S * 2**self._in_a_row)
        self.deaths += 1
        self._in_a_row += 1
        return own, delay


def given_up(entry: FrameEntry, death: WorkerDied) -> FrameSetAside | None:
    """That the frame is set aside for this death, counted already; or None: it is tried again."""
    own, other = entry.note.own_deaths, entry.note.other_deaths
    if own >= OWN_DEATHS:
        reason = f"the worker died {own} times while it reconstructed this frame: {death.reason}"
    elif other >= OTHER_DEATHS:
        reason = f"the worker was killed {other} times while it reconstructed this frame: {death.reason}"
    else:
        return None
    return FrameSetAside(index=death.index, reason=reason)
