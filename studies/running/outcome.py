"""One row of the fault table, and the table itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from client.cli.scores import Column, markdown


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


COLUMNS = (Column("fault", "name"), Column("target", "target"), Column("found", "found"), Column("", "verdict"))


def table(outcomes: Sequence[ScenarioResult]) -> str:
    """Formats the outcomes as a Markdown table, with one row per fault."""
    rows = [
        vars(one)
        | {"found": "; ".join([*one.faults, one.found]), "verdict": "reached" if one.reached else "**missed**"}
        for one in outcomes
    ]
    return markdown(rows, COLUMNS)
