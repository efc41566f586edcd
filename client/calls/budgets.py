"""Calls on budgets of updates, and on the measured accuracy against time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

from client.calls.call import Call, body, json_reader, path
from client.wire import Budget, ReplayRequest, SceneBudget, TradeoffModel
from client.wire.budgets import BudgetFields


def budget(id: str) -> Call[SceneBudget]:
    """Reads the budget of a scene's updates.

    >>> client.budget(scene).effective.iterations
    100
    """
    return Call("GET", path(id, "budget"), json_reader(SceneBudget))


def set_budget(id: str, **budget: Unpack[BudgetFields]) -> Call[SceneBudget]:
    """Sets another budget, from the first frame on that is not begun.

    Args:
        id: of the scene.
        budget: fields of `client.wire.Budget`: iterations, budget_ms, stop_gain, still. A field that is left out, or
            None, is as the scene was made.

    >>> found = client.set_budget(scene, iterations=50)
    >>> found.effective.iterations, found.since
    (50, 3)
    >>> client.set_budget(scene).effective.iterations  # as the scene was made
    100
    """
    return Call("PUT", path(id, "budget"), json_reader(SceneBudget), arguments=body(Budget(**budget)))


def tradeoff(id: str) -> Call[TradeoffModel]:
    """Reads the measured points of accuracy against time, for this scene on its machine.

    >>> "measured" in [point.kind for point in client.tradeoff(scene).points]
    True
    """
    return Call("GET", path(id, "tradeoff"), json_reader(TradeoffModel))


def replay(id: str, iterations: Sequence[int] = (25, 50, 200), frames: int = 4) -> Call[TradeoffModel]:
    """Measures other numbers of iterations: the newest frames are updated again, in the background and in memory.

    `tradeoff` reports its progress, and has the points when it is done.

    Args:
        id: of the scene.
        iterations: a frame, each a replay; the scene's own number is always measured too.
        frames: that are replayed; their pictures must still be held.

    >>> client.replay(scene, [50], frames=1).replay.state
    <ReplayState.RUNNING: 'running'>
    >>> client.end_replay(scene).scene == scene
    True
    """
    request = ReplayRequest(iterations=list(iterations), frames=frames)
    return Call("POST", path(id, "tradeoff"), json_reader(TradeoffModel), repeatable=False, arguments=body(request))


def end_replay(id: str) -> Call[TradeoffModel]:
    """Ends the replay that is running, if one is; what it has measured stays.

    >>> client.end_replay(scene).scene == scene
    True
    """
    return Call("DELETE", path(id, "tradeoff"), json_reader(TradeoffModel))
