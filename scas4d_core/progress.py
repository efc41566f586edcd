"""Progress of a long task, as the first frame reports it."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Progress:
    """Progress of a long task.

    Attributes:
        stage: in words. done, total: of its steps. detail: figures by name, as the loss.
    """

    stage: str
    done: int
    total: int
    detail: dict[str, float] = field(default_factory=dict)
