"""Wire models of update budgets."""

from __future__ import annotations

from typing import Annotated, TypedDict

from pydantic import Field

from client.wire.base import Model

MOST_ITERATIONS = 100_000
LONGEST_MS = 3_600_000.0

Iterations = Annotated[int, Field(strict=True, ge=1, le=MOST_ITERATIONS)]


class Budget(Model):
    """Limits of a scene's updates. Null fields default to the scene's settings."""

    iterations: Iterations | None = Field(
        default=None, description="Iterations per frame; see the setting `update.iterations`."
    )
    budget_ms: float | None = Field(
        default=None,
        strict=True,
        gt=0,
        le=LONGEST_MS,
        allow_inf_nan=False,
        description=(
            "Milliseconds per frame, including decoding and commit. As many iterations run as fit, "
            "regardless of `iterations`."
        ),
    )
    stop_gain: float | None = Field(
        default=None,
        strict=True,
        ge=0,
        lt=1,
        description=(
            "End an update once ten iterations lower its error on four training views by less than "
            "this share; 0: never."
        ),
    )
    skip_tolerance: float | None = Field(
        default=None,
        strict=True,
        ge=-1,
        le=1000,
        allow_inf_nan=False,
        description=(
            "Skip the update if the previous state's error on the probe views is at most (1 + this) × "
            "the usual error; -1: never skip."
        ),
    )


class BudgetFields(TypedDict, total=False):
    """Fields of `Budget` as keyword arguments. Omitted fields default to the scene's settings."""

    iterations: int | None
    budget_ms: float | None
    stop_gain: float | None
    skip_tolerance: float | None


class EffectiveBudget(Model):
    """The effective limits, with every field filled in."""

    iterations: int
    budget_ms: float | None = Field(description="Milliseconds per frame; null: no limit.")
    stop_gain: float
    skip_tolerance: float


class SceneBudget(Model):
    """The requested and effective budget of a scene."""

    scene: str
    requested: Budget = Field(description="The budget as last set; a field is null if it was never set.")
    effective: EffectiveBudget = Field(description="The budget that applies to frames that have not started.")
    since: int = Field(description="The first frame to which it applies.")
