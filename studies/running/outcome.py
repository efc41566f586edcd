"""One row of the fault table, and the table itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass
class ScenarioResult:
    """Result of one fault scenario.

    Attributes:
        name: name of the fault.
        target: required behaviour, in words.
        found: observed behaviour, in words.
        faults: reasons why the target is missed; empty if it is reached.
    """

    name: str
    target: str
    found: str
    faults: list[str] = field(default_factory=list)

    @property
    def reached(self) -> bool:
        """Whether the target is reached, that is, ``faults`` is empty."""
        return not self.faults


def table(outcomes: Sequence[ScenarioResult]) -> str:
    """Formats the outcomes as a Markdown table, with one row per fault."""
    rows = ["| fault | target | found | |", "|---|---|---|---|"]
    for outcome in outcomes:
        summary = "; ".join([*outcome.faults, *([outcome.found] if outcome.found else [])])
        rows.append(
            f"| {outcome.name} | {outcome.target} | {summary} | {'reached' if outcome.reached else '**missed**'} |"
        )
    return "\n".join(rows)
