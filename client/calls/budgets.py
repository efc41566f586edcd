"""Calls for update budgets and the measured trade-off between accuracy and time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from client.calls.call import Call, body, json_reader, path
from client.wire import Budget, ReplayRequest, SceneBudget, TradeoffModel
from client.wire.budgets import BudgetFields


def budget(id: str) -> Call[SceneBudget]:
    """Returns the update budget of a scene.

    >>> client.budget(scene).effective.iterations
    100
    """
    return Call("GET", path(id, "budget"), json_reader(SceneBudget))


def set_budget(id: str, **budget: Unpack[BudgetFields]) -> Call[SceneBudget]:
    """Sets the budget for all frames whose reconstruction has not started.

    Args:
        id: scene id.
        budget: fields of `client.wire.Budget`: iterations, budget_ms, keep_up_fps, stop_gain, skip_tolerance. Fields
            that are omitted or None default to the scene's settings.

    >>> found = client.set_budget(scene, iterations=50)
    >>> found.effective.iterations, found.since
    (50, 3)
    >>> client.set_budget(scene).effective.iterations  # the scene's own settings
    100
    """
    return Call("PUT", path(id, "budget"), json_reader(SceneBudget), arguments=body(Budget(**budget)))


def tradeoff(id: str) -> Call[TradeoffModel]:
    """Returns the measured trade-off between accuracy and time for this scene on its machine.

    >>> "measured" in [point.kind for point in client.tradeoff(scene).points]
    True
    """
    return Call("GET", path(id, "tradeoff"), json_reader(TradeoffModel))


def replay(id: str, iterations: Sequence[int] = (25, 50, 200), frames: int = 4) -> Call[TradeoffModel]:
    """Measures other iteration counts by replaying the updates of the newest frames in memory, in the background.

    `tradeoff` reports the progress and, once the replay has finished, the results.

    Args:
        id: scene id.
        iterations: iteration counts per frame to measure, one replay each; the scene's own count is always included.
        frames: number of frames to replay; their images must still be stored.

    >>> client.replay(scene, [50], frames=1).replay.state
    <ReplayState.RUNNING: 'running'>
    >>> client.end_replay(scene).scene == scene
    True
    """
    request = ReplayRequest(iterations=list(iterations), frames=frames)
    return Call("POST", path(id, "tradeoff"), json_reader(TradeoffModel), repeatable=False, arguments=body(request))


def end_replay(id: str) -> Call[TradeoffModel]:
    """Stops a running replay, if any; its measurements are kept.

    >>> client.end_replay(scene).scene == scene
    True
    """
    return Call("DELETE", path(id, "tradeoff"), json_reader(TradeoffModel))
