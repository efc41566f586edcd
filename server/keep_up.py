"""Limits of an update that must keep up with the frame rate of the cameras."""

from __future__ import annotations

from client.wire import Budget, IngestSettings

SHARE = 0.9
"""Share of the frame interval that an update may take, so that slower frames do not delay the next ones."""
CATCH_UP = 4
"""Number of waiting frames at which an update may take only half of that time."""

SHORTEST = 3
"""Largest factor by which updates are shortened before frames are skipped. If frames arrive three times too fast,
`robot` at half size loses 0.7 dB with shortened updates, and 5.4 dB with every third frame. At full size, an update
with a third of the iterations misses a fast motion (``scripts/bench gaps``)."""

SKIPPING_QUEUE = 8
"""Minimum default of `queue_frames` in scenes that skip frames, so that one long update does not fill the queue. If
frames of `robot` arrive three times too fast, a queue of 4 loses 2.9 dB and five parts, and this one 1.4 dB and no part
(``scripts/bench gaps``)."""


def queue_limit(ingest: IngestSettings, default: int) -> int:
    """Returns the maximum number of acknowledged but unfinished frames of a scene.

    Args:
        ingest: ingest settings of the scene.
        default: maximum in scenes that refuse frames and have no maximum of their own.

    Example:
        >>> queue_limit(IngestSettings(), 4), queue_limit(IngestSettings(when_full="skip"), 4)
        (4, 8)
    """
    skips = ingest.when_full == "skip"
    return ingest.queue_frames or (max(default, SKIPPING_QUEUE) if skips else default)


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


def with_fewer_iterations(budget: Budget, waiting: int, iterations: int) -> Budget:
    """Returns the budget of a frame in a scene that skips frames when its queue is full.

    While later frames are waiting, updates are shortened, so that the queue drains before frames must be skipped. A
    budget with its own iterations or time limit is unchanged.

    Args:
        budget: budget that applies to a frame.
        waiting: number of later frames that are waiting.
        iterations: number of iterations in the scene's settings.

    Example:
        >>> [with_fewer_iterations(Budget(), waiting, 100).iterations for waiting in range(5)]
        [None, 50, 33, 33, 33]
    """
    if waiting == 0 or any(limit is not None for limit in (budget.iterations, budget.budget_ms, budget.keep_up_fps)):
        return budget
    return budget.model_copy(update={"iterations": max(1, iterations // min(1 + waiting, SHORTEST))})
