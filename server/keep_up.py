"""Time limit of an update under a budget that keeps up with the frame rate of the cameras."""

from __future__ import annotations

from client.wire import Budget

SHARE = 0.9
"""Share of the frame interval that an update may take, so that slower frames do not delay the next ones."""
CATCH_UP = 4
"""Number of waiting frames at which an update may take only half of that time."""


def with_time_limit(budget: Budget, waiting: int) -> Budget:
    """Returns the budget with the milliseconds that follow from `keep_up_fps`; unchanged without `keep_up_fps`.

    The more frames are waiting, the less time each gets, so that the queue drains before frames must be skipped.

    Args:
        budget: budget that applies to a frame.
        waiting: number of later frames that are waiting.

    Example:
        >>> with_time_limit(Budget(keep_up_fps=10), waiting=0).budget_ms
        90.0
        >>> with_time_limit(Budget(keep_up_fps=10), waiting=4).budget_ms
        45.0
    """
    if budget.keep_up_fps is None:
        return budget
    milliseconds = 1000 / budget.keep_up_fps * SHARE / (1 + waiting / CATCH_UP)
    return budget.model_copy(update={"budget_ms": round(milliseconds, 3)})
