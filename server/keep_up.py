"""Time limit of an update that must keep up with the frame rate of the cameras."""

from __future__ import annotations

from client.wire import Budget

SHARE = 0.9
"""Share of the frame interval that an update may take, so that slower frames do not delay the next ones."""
LEAST_MS = 1.0
"""Shortest time limit in milliseconds, for frames that arrive almost at once."""
CATCH_UP = 4
"""Number of waiting frames at which an update may take only half of that time."""


def with_time_limit(budget: Budget, waiting: int, frame_seconds: float | None = None) -> Budget:
    """Returns the budget with the milliseconds that follow from the frame rate; unchanged if no rate applies.

    The more frames are waiting, the less time each gets, so that the queue drains before frames must be skipped.

    Args:
        budget: budget that applies to a frame. `keep_up_fps` takes precedence over `frame_seconds`.
        waiting: number of later frames that are waiting.
        frame_seconds: measured interval between frames in seconds. It applies only to a budget without iterations and
            time limit. None if updates need not keep up.

    Example:
        >>> with_time_limit(Budget(keep_up_fps=10), waiting=0).budget_ms
        90.0
        >>> with_time_limit(Budget(keep_up_fps=10), waiting=4).budget_ms
        45.0
        >>> with_time_limit(Budget(), waiting=0, frame_seconds=0.1).budget_ms
        90.0
    """
    if budget.keep_up_fps is not None:
        seconds = 1 / budget.keep_up_fps
    elif frame_seconds is not None and budget.iterations is None and budget.budget_ms is None:
        seconds = frame_seconds
    else:
        return budget
    milliseconds = 1000 * seconds * SHARE / (1 + waiting / CATCH_UP)
    return budget.model_copy(update={"budget_ms": max(LEAST_MS, round(milliseconds, 3))})
