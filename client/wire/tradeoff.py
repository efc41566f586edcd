"""Accuracy against time of a scene on its machine, on the wire."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from client.wire.base import Model
from client.wire.budgets import EffectiveBudget, Iterations

MOST_REPLAYED = 16
MOST_BUDGETS = 8


class PointKind(StrEnum):
    """Origin of a point: measured, extrapolated or replayed."""

    MEASURED = "measured"
    REPLAYED = "replayed"
    EXTRAPOLATED = "extrapolated"


class TradeoffPoint(Model):
    """Milliseconds, error and PSNR of a frame with so many iterations."""

    kind: PointKind = Field(
        description="measured: frames that the scene committed. replayed: frames of the scene, updated again in the "
        "background with another number of iterations. extrapolated: by `model`, from what was measured."
    )
    iterations: int = Field(description="A frame. Measured: what frames ran, to two significant digits.")
    milliseconds: float = Field(description="A frame from decoding to the end of the commit; the median.")
    error: float | None = Field(
        description="Mean image loss of the probe views, at most four training views, of the committed state; null "
        "where not measured. What is extrapolated has none."
    )
    psnr: float | None = Field(description="dB, of training views as they were last rendered; null as `error`.")
    frames: int = Field(description="That went into it; 0 for what is extrapolated.")
    threads: int | None = Field(description="That the update ran on; compare times of equal ones.")


class CurveMean(Model):
    """Mean progress of updates after so many of their iterations."""

    planned: int = Field(description="Iterations in all.")
    iterations: int
    milliseconds: float = Field(description="Since the update began, after decoding; the median.")
    loss: float = Field(description="Training loss of the iterations since the point before; the mean.")
    frames: int


class TimeModel(Model):
    """milliseconds = fixed + per_iteration x iterations, medians over the newest frames."""

    fixed: float
    per_iteration: float
    frames: int = Field(description="That it was taken from.")


class ReplayState(StrEnum):
    """State of the replay that was asked for last."""

    NONE = "none"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


class ReplayStatus(Model):
    """The replay that was asked for last; it and its points are kept in memory, until the service ends."""

    state: ReplayState = ReplayState.NONE
    iterations: list[int] = Field(default_factory=list, description="Its budgets; the scene's own is the first.")
    frames: list[int] = Field(default_factory=list, description="That count.")
    warm_up: int | None = Field(default=None, description="The frame before them: it starts cold, and is not counted.")
    threads: int | None = None
    done: int = Field(default=0, description="Updates that are over.")
    total: int = 0
    error: str | None = Field(default=None, description="Why it failed.")


class TradeoffModel(Model):
    """Accuracy against time, for this scene on this machine."""

    scene: str
    points: list[TradeoffPoint] = Field(description="By kind, then by iterations.")
    curve: list[CurveMean] = Field(description="Within updates, of the budgets that were measured.")
    model: TimeModel | None = Field(description="Null until an update was measured.")
    budget: EffectiveBudget = Field(description="What frames that are not begun get.")
    replay: ReplayStatus


class ReplayRequest(Model):
    """A request to measure budgets."""

    iterations: Annotated[list[Iterations], Field(min_length=1, max_length=MOST_BUDGETS)] = Field(
        default=[25, 50, 200], description="A frame, each a replay. The scene's own number is always measured too."
    )
    frames: int = Field(
        default=4,
        strict=True,
        ge=1,
        le=MOST_REPLAYED,
        description="The newest so many; one more before them warms up. Their pictures must still be held.",
    )
