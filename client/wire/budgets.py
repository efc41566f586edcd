"""Budgets of updates, on the wire."""

from __future__ import annotations

from typing import Annotated, TypedDict

from pydantic import Field

from client.wire.base import Model

MOST_ITERATIONS = 100_000
LONGEST_MS = 3_600_000.0

Iterations = Annotated[int, Field(strict=True, ge=1, le=MOST_ITERATIONS)]


class Budget(Model):
    """Limits of a scene's updates. A field that is null is as the scene was made."""

    iterations: Iterations | None = Field(default=None, description="A frame; of `update.iterations`.")
    budget_ms: float | None = Field(
        default=None,
        strict=True,
        gt=0,
        le=LONGEST_MS,
        allow_inf_nan=False,
        description="Milliseconds a frame, decoding and commit included: as many iterations as fit, whatever "
        "`iterations` says.",
    )
    stop_gain: float | None = Field(
        default=None,
        strict=True,
        ge=0,
        lt=1,
        description="An update ends once ten iterations lower its error on four training views by less than this "
        "share; 0: never.",
    )
    skip_tolerance: float | None = Field(
        default=None,
        strict=True,
        ge=-1,
        le=1000,
        allow_inf_nan=False,
        description="A frame needs no iteration where the one before shows it with at most 1 + this times the usual "
        "error; -1: every frame is updated.",
    )


class BudgetFields(TypedDict, total=False):
    """Fields of `Budget` as keyword arguments; one that is left out is as the scene was made."""

    iterations: int | None
    budget_ms: float | None
    stop_gain: float | None
    skip_tolerance: float | None


class EffectiveBudget(Model):
    """The limits that apply, each field filled in."""

    iterations: int
    budget_ms: float | None = Field(description="Milliseconds a frame; null: no limit.")
    stop_gain: float
    skip_tolerance: float


class SceneBudget(Model):
    """The budget of a scene."""

    scene: str
    asked: Budget = Field(description="As it was put last; nulls where nothing was.")
    effective: EffectiveBudget = Field(description="What frames that are not begun get.")
    since: int = Field(description="The first frame that it holds for.")
