"""Progress reports for long tasks, such as the fit of the first frame."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """Progress of a long task.

    Attributes:
        stage: description of the current stage.
        done: number of completed steps.
        total: total number of steps.
        detail: additional named values, such as the loss.
    """

    stage: str
    done: int
    total: int
    detail: dict[str, float] = field(default_factory=dict)
