"""Predicts when a scene's worker ends the frame at work, from the frames before it and from its progress."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from statistics import median

UPDATES_KEPT = 8
"""Updates that the prediction is the median of: a budget that changes shows after a few frames."""
FIRST_GUESS_S = 1.0
"""An update, before one has been seen."""
SHORTEST_S = 0.1
"""Nothing is predicted to end sooner."""
OVERDUE = 0.25
"""A frame that takes longer than predicted is given this share of what it has taken so far."""


class WorkClock:
    """Times the frames of one scene.

    Frame 0 is never taken for an update: it takes minutes where an update takes a second.

    Args:
        now: seconds of a clock that never goes back.

    Example:
        >>> seconds = iter([0.0, 2.0, 2.0, 2.5])
        >>> clock = WorkClock(lambda: next(seconds))
        >>> clock.begin(first=False)
        >>> clock.end(committed=True)
        >>> clock.begin(first=False)
        >>> clock.remaining()
        1.5
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._updates: deque[float] = deque(maxlen=UPDATES_KEPT)
        self._began: float | None = None
        self._first = False
        self._stage = ""
        self._stage_began = 0.0
        self._done = 0.0
        self._stalled_until: float | None = None

    @property
    def update_seconds(self) -> float:
        """An update as predicted."""
        return median(self._updates) if self._updates else FIRST_GUESS_S

    def begin(self, *, first: bool) -> None:
        """The worker has a frame; ``first``: there is no committed state before it."""
        self._began, self._first, self._stalled_until = self._now(), first, None
        self._stage, self._done = "", 0.0

    def progress(self, stage: str, done: int, total: int) -> None:
        """Frame 0 is this far in one of its stages."""
        if stage != self._stage:
            self._stage, self._stage_began = stage, self._now()
        self._done = done / total if total > 0 else 0.0

    def stall(self, seconds: float) -> None:
        """The frame at work waits for room on the disk and is tried again after so long."""
        self._stalled_until = self._now() + seconds

    def end(self, *, committed: bool) -> None:
        """The worker has no frame any more; a frame that was not committed, or stalled, says nothing of the next."""
        if committed and self._began is not None and not self._first and self._stalled_until is None:
            self._updates.append(self._now() - self._began)
        self._began = self._stalled_until = None

    def remaining(self) -> float:
        """Seconds until the frame at work ends; where there is none yet, an update."""
        if self._began is None:
            return max(SHORTEST_S, self.update_seconds)
        now = self._now()
        if self._stalled_until is not None:
            return max(0.0, self._stalled_until - now) + self.update_seconds
        elapsed = now - self._began
        if self._first:
            in_stage = now - self._stage_began
            if 0 < self._done < 1:
                return max(SHORTEST_S, in_stage * (1 - self._done) / self._done)
            return max(SHORTEST_S, OVERDUE * elapsed)  # between two stages nothing better is known
        return max(SHORTEST_S, self.update_seconds - elapsed, OVERDUE * (elapsed - self.update_seconds))
