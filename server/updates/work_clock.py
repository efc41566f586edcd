"""Prediction of when the current update ends, so that clients know how long to wait."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from statistics import median

UPDATES_KEPT = 8
"""Number of recent updates in the median, small enough to adapt to a budget change within a few frames."""
FIRST_GUESS_S = 1.0
"""Predicted seconds per update before any update has been timed."""
SHORTEST_S = 0.1
"""Minimum prediction in seconds."""
OVERDUE = 0.25
"""Predicted remaining time of an overdue update, as a fraction of its delay beyond the prediction.

Between two stages of frame 0, the prediction is this fraction of the elapsed time.
"""


class WorkClock:
    """Predictor of the end of the current update, based on the durations of earlier updates and on its progress.

    The first frame is not counted as an update, because its reconstruction takes minutes, whereas
    an update takes about a second.

    Args:
        now: monotonic clock that returns seconds.

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
        """Predicted duration of an update in seconds."""
        return median(self._updates) if self._updates else FIRST_GUESS_S

    def begin(self, *, first: bool) -> None:
        """Records the start of a frame; ``first`` is true if no committed state precedes it."""
        self._began, self._first, self._stalled_until = self._now(), first, None
        self._stage, self._done, self._first_end = "", 0.0, None

    def progress(self, stage: str, done: int, total: int, seconds: float | None = None) -> None:
        """Records the progress of the first frame within a stage.

        Args:
            stage: name of the stage.
            done: completed part of the stage.
            total: value of `done` at the end of the stage.
            seconds: predicted time until the end of the frame in seconds, or None.
        """
        if stage != self._stage:
            self._stage, self._stage_began = stage, self._now()
        self._done = done / total if total > 0 else 0.0
        self._first_end = None if seconds is None else self._now() + seconds

    def stall(self, seconds: float) -> None:
        """Records that the current frame is waiting for disk space and will be retried after `seconds`."""
        self._stalled_until = self._now() + seconds

    def end(self, *, committed: bool) -> None:
        """Records the end of a frame; frames that stalled or were not committed are not timed."""
        if committed and self._began is not None and not self._first and self._stalled_until is None:
            self._updates.append(self._now() - self._began)
        self._began = self._stalled_until = None

    def remaining(self) -> float:
        """Returns the predicted time in seconds until the current frame ends.

        If no frame is being processed, the result is the predicted duration of an update.
        """
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
            return max(SHORTEST_S, OVERDUE * elapsed)  # no better estimate between two stages
        return max(SHORTEST_S, self.update_seconds - elapsed, OVERDUE * (elapsed - self.update_seconds))
