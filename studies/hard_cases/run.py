"""Runs the catalogue of hard cases on every available backend and formats the results."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.util import find_spec
from typing import Any

import numpy as np

from scas4d_core.guards import CONVENTIONS, GUARDS, OBSERVED, Guard
from studies.hard_cases import cluster_map, geometry, scenes, steps
from studies.hard_cases.case import CPU, REFERENCE, TORCH, HardCase
from studies.machine import in_words as in_words_of
from studies.machine import machine
from studies.options import Echo

SECTIONS: tuple[tuple[str, tuple[HardCase, ...]], ...] = (
    ("Gaussians rendered", geometry.CASES),
    ("Clusters and deformations", cluster_map.CASES),
    ("Steps, parameters, losses, clustering", steps.CASES),
    ("Whole scenes", scenes.CASES),
)
CASES = tuple(case for _, cases in SECTIONS for case in cases)

BEGIN, END = "<!-- scripts/bench stability: begin -->", "<!-- scripts/bench stability: end -->"


@dataclass
class CaseResult:
    """Result of one case at one size: tested backends, guards triggered on the CPU, and violated checks."""

    case: str
    size: str
    backends: list[str] = field(default_factory=list)
    guards: dict[str, int] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0


def backends() -> list[str]:
    """Returns the available backends, starting with the float64 reference in PyTorch."""
    return [CPU] if find_spec("torch") is None else [REFERENCE, CPU, TORCH]


def selected(names: Sequence[str] | None, slow: bool) -> list[HardCase]:
    """Returns the cases whose name contains one of ``names``, or all cases if it is empty.

    Slow cases are returned only if they are named or ``slow`` is True.

    Raises:
        ValueError: no case name contains one of the names.
    """
    for name in names or ():
        if not any(name in case.name for case in CASES):
            raise ValueError(f"no case name contains {name!r}; known cases: {', '.join(case.name for case in CASES)}")
    if names:
        return [case for case in CASES if any(name in case.name for name in names)]
    return [case for case in CASES if slow or not case.slow]


def run_case(case: HardCase, size: Any, on: Iterable[str]) -> CaseResult:
    """Runs one case at one size on the given backends. An exception counts as a violation."""
    line = CaseResult(case.name, str(size))
    started = time.perf_counter()
    try:
        with np.errstate(all="ignore"):
            problem = case.make(size)
            outcomes = {name: outcome for name in on if (outcome := problem.run(name)) is not None}
            line.backends = list(outcomes)
            line.violations = problem.violations(outcomes) + case.holds(problem, outcomes)
        if CPU in outcomes:
            line.guards = {name: count for name, count in outcomes[CPU].guards.items() if count}
    except Exception as error:
        line.violations.append(f"raised {type(error).__name__}: {error}")
    line.seconds = time.perf_counter() - started
    return line


def run(names: Sequence[str] | None = None, *, slow: bool = True, echo: Echo = print) -> list[CaseResult]:
    """Runs all sizes of the selected cases, reports each result immediately, and returns the results."""
    on = backends()
    lines = []
    for case in selected(names, slow):
        for size in case.sizes:
            line = run_case(case, size, on)
            lines.append(line)
            echo(f"{'passed' if not line.violations else 'FAILED'}  {case.name}, {line.size}  {in_words(line.guards)}")
            for violation in line.violations:
                echo(f"       {violation}")
    failed = sum(bool(line.violations) for line in lines)
    echo(f"{len({line.case for line in lines})} cases ({len(lines)} counting each size separately), {failed} failures")
    return lines


def in_words(guards: dict[str, int]) -> str:
    """Formats the guard counts, largest first."""
    return ", ".join(f"{name} {count:,}" for name, count in sorted(guards.items(), key=lambda item: -item[1]))


def catalogue_table(lines: Sequence[CaseResult]) -> str:
    """Returns a Markdown table with one row per section: numbers of cases and sizes, and failing cases."""
    text = ["| section | cases | counting sizes | failures |", "|" + "---|" * 4]
    for title, cases in SECTIONS:
        names = {case.name for case in cases}
        ran = [line for line in lines if line.case in names]
        failed = ", ".join(f"{line.case} {line.size}" for line in ran if line.violations)
        text.append(f"| {title} | {len({line.case for line in ran})} | {len(ran)} | {failed or '–'} |")
    return "\n".join(text)


def guards_table(guards: Iterable[Guard]) -> str:
    """Returns a Markdown table with one row per guard: value, first clause of its reason, and what it counts."""
    lines = ["| guard | value | acts on | counts |", "|" + "---|" * 4]
    for guard in guards:
        clause = guard.reason.split(":")[0].split(". ")[0].rstrip(".")
        lines.append(f"| `{guard.name}` | {guard.value:g} {guard.unit} | {clause} | {guard.counted} |")
    return "\n".join(lines)


def page(lines: Sequence[CaseResult], failing: dict[str, list[str]] | None, on: str, date: str) -> str:
    """Returns the generated part of docs/stability.md."""
    count, failed = len({line.case for line in lines}), sum(bool(line.violations) for line in lines)
    tried = "" if failing is None else (
        f" `scripts/bench stability --mutate` removes each guard and each convention in turn: "
        f"{sum(bool(cases) for cases in failing.values())} of {len(failing)} removals make a case fail."
    )  # fmt: skip
    observed = "\n".join(f"- `{name}`: {words}" for name, words in OBSERVED.items())
    conventions = ", ".join(f"`{guard.name}`" for guard in CONVENTIONS.values())
    return f"""{BEGIN}

`scripts/bench stability --out docs/stability.md` on {date} ({on}): {count} cases ({len(lines)} counting each size
separately), {failed} failures.{tried}

{catalogue_table(lines)}

Each frame's report counts how often each guard acted (`guards`):

{guards_table(GUARDS.values())}

Also counted, although they do not change the result:

{observed}

Conventions always apply and are not counted: {conventions}.

{END}"""


def here() -> tuple[str, str]:
    """Returns a description of the machine, and today's date."""
    return in_words_of(machine()), datetime.now(UTC).date().isoformat()
