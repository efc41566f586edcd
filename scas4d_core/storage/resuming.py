"""Where a scene goes on: the newest commit whose state can be read, and whose checkpoint can, wherever possible."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from scas4d_core.storage.checkpoint import CarryOver, CheckpointError, Checkpoints
from scas4d_core.storage.history import History, HistoryError
from scas4d_core.update.views import ViewFactory


class ResumeError(ValueError):
    """A history that cannot be gone on from; the message says what is damaged."""


@dataclass(frozen=True)
class Resumed:
    """Where a scene was taken up again.

    Attributes:
        index: the commit that it goes on from.
        undone: committed frames after it that were taken back; each has to be given again, or is lost.
        faults: why, a sentence for each file that could not be used; empty after an ordinary end.
        cold: the state is whole, but what the next update needs beside it is not: that starts without a motion, and
            the scene is no longer bit-identical to one that was not disturbed.
    """

    index: int
    undone: list[int]
    faults: list[str]
    cold: bool


def find_commit(
    history: History, checkpoints: Checkpoints, factory: ViewFactory, held: Callable[[int], bool]
) -> tuple[int, CarryOver | None, list[str]]:
    """The commit to go on from, what it left to the next update (None: a cold start), and what was found damaged.

    Args:
        factory: of the scene's views. held: whether the pictures of a committed frame can be given again.

    Raises:
        ResumeError: no state can be read.
    """
    faults = list(history.damaged.values())
    whole: list[int] = []
    carried: CarryOver | None = None
    for index in reversed(history.indices):
        try:
            history.gaussians(index)
            history.report(index)
            whole.append(index)
            carried = checkpoints.load(index, factory)
            break
        except (HistoryError, CheckpointError) as error:
            faults.append(str(error))
            if index not in checkpoints.indices() and whole:
                break  # so old that it has none any more: nothing before it has one either
    if not whole:
        raise ResumeError("no state can be read: " + "; ".join(faults))
    later = sorted({*history.indices, *history.damaged})
    if carried is None or not all(held(index) for index in later if index > whole[-1]):
        return whole[0], None, faults
    return whole[-1], carried, faults
