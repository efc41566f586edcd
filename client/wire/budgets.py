"""Wire models of update budgets."""

from __future__ import annotations

from typing import Annotated, TypedDict

from pydantic import Field

from client.wire.base import Model

MOST_ITERATIONS = 100_000
LONGEST_MS = 3_600_000.0
LOWEST_FPS = 1000 / LONGEST_MS

Iterations = Annotated[int, Field(strict=True, ge=1, le=MOST_ITERATIONS)]


class Budget(Model):
    """Limits for a scene's updates. Null fields default to the scene's settings."""

    iterations: Iterations | None = None
    """Iterations per frame; see the setting `update.iterations`."""
    budget_ms: float | None = Field(default=None, strict=True, gt=0, le=LONGEST_MS, allow_inf_nan=False)
    """Milliseconds per frame, until the new state is in memory. The update runs as many iterations as fit, regardless
    of `iterations`.
    """
    keep_up_fps: float | None = Field(default=None, strict=True, ge=LOWEST_FPS, le=1000, allow_inf_nan=False)
    """Frames per second to keep up with. It replaces `budget_ms`: each frame gets the time that this rate leaves, and
    less while frames are waiting.
    """
    stop_gain: float | None = Field(default=None, strict=True, ge=0, lt=1)
    """End an update once ten iterations lower its error on four training views by less than this fraction; 0 to never
    end it early.
    """
    skip_tolerance: float | None = Field(default=None, strict=True, ge=-1, le=1000, allow_inf_nan=False)
    """Skip the update if the previous state's error on the probe views is at most (1 + this value) × the usual error;
    -1 to never skip.
    """


class BudgetFields(TypedDict, total=False):
    """Fields of `Budget` as keyword arguments. Omitted fields default to the scene's settings."""

    iterations: int | None
    budget_ms: float | None
    keep_up_fps: float | None
    stop_gain: float | None
    skip_tolerance: float | None


class EffectiveBudget(Model):
    """The limits in effect, with defaults filled in."""

    iterations: int
    budget_ms: float | None
    """Milliseconds per frame while no frame is waiting; null for no limit."""
    keep_up_fps: float | None = None
    """Frames per second to keep up with; null for none."""
    stop_gain: float
    skip_tolerance: float


class SceneBudget(Model):
    """The requested and the effective budget of a scene."""

    scene: str
    requested: Budget
    """The most recently requested budget; fields that were not set are null."""
    effective: EffectiveBudget
    """The budget for frames whose update has not started."""
    since: int
    """The first frame to which the effective budget applies."""
