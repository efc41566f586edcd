"""Wire models of the trade-off between accuracy and time."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import Field

from client.wire.base import Model
from client.wire.budgets import EffectiveBudget, Iterations

MOST_REPLAYED = 16
MOST_BUDGETS = 8


class PointKind(StrEnum):
    """The origin of a point: measured, replayed or extrapolated."""

    MEASURED = "measured"
    REPLAYED = "replayed"
    EXTRAPOLATED = "extrapolated"


class TradeoffPoint(Model):
    """Time, error and PSNR per frame for a number of iterations."""

    kind: PointKind
    """measured: from frames that the scene committed. replayed: from frames updated again in the background with a
    different number of iterations. extrapolated: computed by `model` from the measured points.
    """
    iterations: int
    """Iterations per frame; rounded to two significant digits for measured points."""
    milliseconds: float
    """Median milliseconds per frame, from decoding to the end of the commit."""
    error: float | None
    """Mean image loss of the committed state on the probe views (at most four training views); null if not measured or
    extrapolated.
    """
    psnr: float | None
    """PSNR in dB on the training views as last rendered; null if not measured or extrapolated."""
    frames: int
    """Number of frames measured; 0 for extrapolated points."""
    threads: int | None
    """Number of threads used for the update. Compare times only for equal numbers."""


class CurveMean(Model):
    """Mean loss and median time of updates after a given number of iterations."""

    planned: int
    """Total number of iterations of the update."""
    iterations: int
    milliseconds: float
    """Median milliseconds since the update started, excluding decoding."""
    loss: float
    """Mean training loss over the iterations since the previous point."""
    frames: int


class TimeModel(Model):
    """Linear time model: milliseconds = fixed + per_iteration × iterations, from medians over the newest frames."""

    fixed: float
    per_iteration: float
    frames: int
    """Number of frames used for the fit."""


class ReplayState(StrEnum):
    """The state of the latest replay."""

    NONE = "none"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"


class ReplayStatus(Model):
    """The latest replay, kept in memory until the service stops."""

    state: ReplayState = ReplayState.NONE
    iterations: list[int] = Field(default_factory=list)
    """Iteration counts to measure; the scene's own count comes first."""
    frames: list[int] = Field(default_factory=list)
    """Indices of the frames that are measured."""
    warm_up: int | None = None
    """Index of the preceding frame, which serves as warm-up and is not measured."""
    threads: int | None = None
    done: int = 0
    """Number of finished updates."""
    total: int = 0
    error: str | None = None
    """Reason why the replay failed."""


class TradeoffModel(Model):
    """Accuracy versus time for this scene on this machine."""

    scene: str
    points: list[TradeoffPoint]
    """Points, ordered by kind, then by iterations."""
    curve: list[CurveMean]
    """Mean progress during updates, for each measured budget."""
    model: TimeModel | None
    """Fitted time model; null until an update has been measured."""
    budget: EffectiveBudget
    """The budget for frames whose update has not started."""
    replay: ReplayStatus


class ReplayRequest(Model):
    """A request to replay frames with other iteration counts."""

    iterations: Annotated[list[Iterations], Field(min_length=1, max_length=MOST_BUDGETS)] = Field(default=[25, 50, 200])
    """Iterations per frame, one replay each. The scene's own iteration count is always measured too."""
    frames: int = Field(default=4, strict=True, ge=1, le=MOST_REPLAYED)
    """Number of newest frames to replay, after one warm-up frame. The frame log must still contain their images."""
