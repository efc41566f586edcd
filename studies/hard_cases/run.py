"""The catalogue run on every backend that is here, and its table."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
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
    """Result of a case in one size: backends that ran, guards that acted on the CPU, laws that do not hold."""

    case: str
    size: str
    backends: list[str] = field(default_factory=list)
    guards: dict[str, int] = field(default_factory=dict)
    violations: list[str] = field(default_factory=list)
    seconds: float = 0.0


def backends() -> list[str]:
    """Those that are here: torch twins in float64 first."""
    return [CPU] if find_spec("torch") is None else [REFERENCE, CPU, TORCH]


def selected(names: Sequence[str] | None, slow: bool) -> list[HardCase]:
    """The cases whose name holds one of ``names`` (all without names); slow ones where asked for, or named.

    Raises:
        ValueError: no case has such a name.
    """
    for name in names or ():
        if not any(name in case.name for case in CASES):
            raise ValueError(f"no case is named {name!r}; known are: {', '.join(case.name for case in CASES)}")
    if names:
        return [case for case in CASES if any(name in case.name for name in names)]
    return [case for case in CASES if slow or not case.slow]


def run_case(case: HardCase, size: Any, on: Iterable[str]) -> CaseResult:
    """One case in one size; what raises does not hold."""
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
    """All sizes of the selected cases; tells each as it is done."""
    on = backends()
    lines = []
    for case in selected(names, slow):
        for size in case.sizes:
            line = run_case(case, size, on)
            lines.append(line)
            echo(f"{'holds' if not line.violations else 'FAILS'}  {case.name}, {line.size}  {in_words(line.guards)}")
            for violation in line.violations:
                echo(f"       {violation}")
    failed = sum(bool(line.violations) for line in lines)
    echo(f"{len({line.case for line in lines})} cases, {len(lines)} with sizes, {failed} do not hold")
    return lines


def in_words(guards: dict[str, int]) -> str:
    """Counts of guards, most first."""
    return ", ".join(f"{name} {count:,}" for name, count in sorted(guards.items(), key=lambda item: -item[1]))


def catalogue_table(lines: Sequence[CaseResult]) -> str:
    """One row a case: what is hard, its source, its sizes, and those that do not hold."""
    by_case: dict[str, list[CaseResult]] = {}
    for line in lines:
        by_case.setdefault(line.case, []).append(line)
    text = []
    for title, cases in SECTIONS:
        text += [
            f"### {title}",
            "",
            "| case | what | from | sizes |",
            "|" + "---|" * 4,
        ]
        for case in cases:
            results = by_case.get(case.name, [])
            if not results:
                continue
            failed = [line.size for line in results if line.violations]
            sizes = ", ".join(line.size for line in results) + (f"; **fails**: {', '.join(failed)}" if failed else "")
            text.append(f"| {case.name} | {case.what} | {case.source} | {sizes} |")
        text.append("")
    return "\n".join(text)


def guards_table(guards: Iterable[Guard], failing: dict[str, list[str]] | None = None, last: str = "counted") -> str:
    """One row a guard; with the cases that fail without it, where they are known."""
    lines = [f"| guard | value | unit | where | why | {last} | without it fail |", "|" + "---|" * 7]
    for guard in guards:
        cases = (failing or {}).get(guard.name)
        words = "not tried" if cases is None else (", ".join(cases) if cases else "**none**")
        lines.append(
            f"| `{guard.name}` | {guard.value:g} | {guard.unit} | `{guard.where}` | {guard.reason} | {guard.counted} "
            f"| {words} |"
        )
    return "\n".join(lines)


def page(lines: Sequence[CaseResult], failing: dict[str, list[str]] | None, on: str, date: str) -> str:
    """The generated part of docs/hard-cases.md."""
    count, failed = len({line.case for line in lines}), sum(bool(line.violations) for line in lines)
    observed = "\n".join(f"- `{name}`: {words}" for name, words in OBSERVED.items())
    tried = "" if failing is None else (
        f"`scripts/bench stability --mutate` removed each guard and each convention in turn, in a copy of the sources, "
        f"and ran the catalogue: {sum(bool(cases) for cases in failing.values())} of {len(failing)} removals make a "
        f"case fail."
    )  # fmt: skip
    return f"""{BEGIN}

Written by `scripts/bench stability --out docs/hard-cases.md` on {date} ({on}).

## The catalogue

{count} cases, {len(lines)} with their sizes; {failed} do not hold.
Each runs on every backend that has its stage: the kernels, and the torch twins in float64 and float32.

{catalogue_table(lines)}
## Guards

A guard is counted each time it acts; `guards` of a frame's report has the counts. {tried}

{guards_table(GUARDS.values(), failing)}

Also counted, without a change of the result:

{observed}

## Conventions

Conventions are part of the equations and act all the time; the sixth column says why they are not counted.

{guards_table(CONVENTIONS.values(), failing, "why not counted")}

{END}"""


def here() -> tuple[str, str]:
    """The machine, in words, and the date."""
    return in_words_of(machine()), datetime.now(UTC).date().isoformat()


def write_page(path: Path, text: str) -> None:
    """Puts the generated part between its two marks; the rest of the page stays. Without marks it goes to the end."""
    old = path.read_text() if path.exists() else "# Numerical stability\n"
    if BEGIN in old and END in old:
        new = old[: old.index(BEGIN)] + text + old[old.index(END) + len(END) :]
    else:
        new = old.rstrip("\n") + "\n\n" + text + "\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(new)
