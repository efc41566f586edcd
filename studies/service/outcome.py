"""One row of the fault table, and the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

Echo = Callable[[str], None]


@dataclass
class ScenarioResult:
    """A fault, the bar, and what was found; with `faults` the bar is missed."""

    name: str
    bar: str
    found: str
    faults: list[str] = field(default_factory=list)

    @property
    def reached(self) -> bool:
        """True where nothing went wrong."""
        return not self.faults


def table(outcomes: Sequence[ScenarioResult]) -> str:
    """As Markdown."""
    rows = ["| fault | bar | found | |", "|---|---|---|---|"]
    for outcome in outcomes:
        found = "; ".join([*outcome.faults, *([outcome.found] if outcome.found else [])])
        rows.append(f"| {outcome.name} | {outcome.bar} | {found} | {'reached' if outcome.reached else '**missed**'} |")
    return "\n".join(rows)
