"""One row of the fault table, and the table itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass
class ScenarioResult:
    """A fault, its target and the outcome; the target is missed if there are `faults`."""

    name: str
    target: str
    found: str
    faults: list[str] = field(default_factory=list)

    @property
    def reached(self) -> bool:
        """Whether there are no faults."""
        return not self.faults


def table(outcomes: Sequence[ScenarioResult]) -> str:
    """Formats the outcomes as Markdown."""
    rows = ["| fault | target | found | |", "|---|---|---|---|"]
    for outcome in outcomes:
        summary = "; ".join([*outcome.faults, *([outcome.found] if outcome.found else [])])
        rows.append(
            f"| {outcome.name} | {outcome.target} | {summary} | {'reached' if outcome.reached else '**missed**'} |"
        )
    return "\n".join(rows)
