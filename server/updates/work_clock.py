"""Predicts when the frame at work ends, so that a sender learns how long to wait."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from statistics import median

UPDATES_KEPT = 8
"""The prediction is the median of so many updates: a changed budget shows after a few frames."""
FIRST_GUESS_S = 1.0
"""Seconds of an update, before one has been timed."""
SHORTEST_S = 0.1
"""The shortest prediction in seconds."""
OVERDUE = 0.25
"""A frame that takes longer than predicted is predicted to take this share of its time so far again."""


class WorkClock:
    """Predicts the end of the frame at work, from the frames before it and from its progress.

    Frame 0 is not counted as an update: it takes minutes where an update takes a second.

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
        self._first_end: float | None = None
        self._stalled_until: float | None = None

    @property
    def update_seconds(self) -> float:
        """Predicted seconds of an update."""
        return median(self._updates) if self._updates else FIRST_GUESS_S

    def begin(self, *, first: bool) -> None:
        """Notes that the worker has a frame; ``first``: there is no committed state before it."""
        self._began, self._first, self._stalled_until = self._now(), first, None
        self._stage, self._done, self._first_end = "", 0.0, None

    def progress(self, stage: str, done: int, total: int, seconds: float | None = None) -> None:
        """Notes how far frame 0 is in one of its stages; `seconds`: predicted until its end."""
        if stage != self._stage:
            self._stage, self._stage_began = stage, self._now()
        self._done = done / total if total > 0 else 0.0
        self._first_end = None if seconds is None else self._now() + seconds

    def stall(self, seconds: float) -> None:
        """Notes that the frame at work waits for room on the disk and is tried again after so long."""
        self._stalled_until = self._now() + seconds

    def end(self, *, committed: bool) -> None:
        """Notes that the worker has no frame; one that was not committed, or stalled, is not counted as an update."""
        if committed and self._began is not None and not self._first and self._stalled_until is None:
            self._updates.append(self._now() - self._began)
        self._began = self._stalled_until = None

    def remaining(self) -> float:
        """Returns the seconds until the frame at work ends; an update where there is none."""
        if self._began is None:
            return max(SHORTEST_S, self.update_seconds)
        now = self._now()
        if self._stalled_until is not None:
            return max(0.0, self._stalled_until - now) + self.update_seconds
        elapsed = now - self._began
        if self._first:
            if self._first_end is not None and now < self._first_end:
                return max(SHORTEST_S, self._first_end - now)
            in_stage = now - self._stage_began
            if 0 < self._done < 1:
                return max(SHORTEST_S, in_stage * (1 - self._done) / self._done)
            return max(SHORTEST_S, OVERDUE * elapsed)  # between two stages nothing better is known
        return max(SHORTEST_S, self.update_seconds - elapsed, OVERDUE * (elapsed - self.update_seconds))
