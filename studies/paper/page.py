"""Writes the page that compares our figures with the paper's tables."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from client.cli.scores import Column, Row, Store, markdown
from studies.frontier.frontier import UPDATES, Variant
from studies.frontier.tradeoff import read_points
from studies.machine import core_version, provenance
from studies.marks import marked, marked_days, marked_table
from studies.paper.figures import SCENES
from studies.paper.paper import (
    EXPERIMENTS,
    FACTOR,
    SMALL,
    ClaimResult,
    Experiment,
    Measured,
    compare,
    iteration_ratio,
    measured,
)

DIGITS: Mapping[str, int] = {"psnr": 2, "ssim": 3, "mte_2d_oracle": 2, "parts_ari": 3}
"""Number of decimals shown for each score."""
AGREEMENT = "paper-agreement"
"""Name of the record of the table that compares all claims."""


def write_paper_page(
    out: Path, captures: Sequence[str], page: Path, updates: int = UPDATES, quality: Path | None = None
) -> str:
    """Writes the page from the rows of the study, with figures marked for ``scripts/figures.py``. Returns its text.

    Args:
        out: frontier study folder.
        captures: capture names.
        page: Markdown file to write.
        updates: number of updates that the rows cover.
        quality: folder of the quality study, for captures without rows in the frontier study.
    """
    ours = measured(out, captures, updates, quality)
    points = read_points(out, captures, updates)
    ratio = iteration_ratio(points)
    there = [name for name in captures if any(point.capture == name for point in points)]
    outcomes = {experiment.title: compare(experiment, ours) for experiment in EXPERIMENTS}
    sections = "\n\n".join(
        section(experiment, ours, captures, ratio) for experiment in EXPERIMENTS if experiment.score != "ssim"
    )
    text = f"""# The paper's tables

We repeated the paper's experiments on our captures. Each cell contains our result, with the paper's in
parentheses. Our captures share names and kinds of motion with the paper's scenes, but not images, so only differences
between settings are comparable.

```
{_commands(captures, there, page)}
```

{_provenance(out, captures)}
Scores are means over the first {updates} updates of each capture. All rows of a capture start from the same
frame 0.{_elsewhere(captures, there)}

## Agreement

{summary([outcome for outcomes_of_variant in outcomes.values() for outcome in outcomes_of_variant], outcomes)}

The gain is the first setting's mean score minus the second's, over the captures that both cover. Two gains agree in
size if they are within a factor of {FACTOR:g}. Two gains also agree if both are small before rounding (below
{", ".join(f"{value:g} {name}" for name, value in SMALL.items() if name in DIGITS)}),
whatever their signs. A small gain agrees with a larger one only within this factor. If the paper shows only an image,
the claim is the sign of the gain. The last column counts the captures whose gain agrees with the claim, at least in
sign. SSIM appears only in this table.

{sections}
"""
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text)
    return text


def section(
    experiment: Experiment,
    ours: Measured,
    captures: Sequence[str],
    ratio: float | None,
) -> str:
    """Formats an experiment as a Markdown section with its source, table and note."""
    names = [name for name in SCENES if name in captures]
    digits = DIGITS[experiment.score]
    unit = f" {experiment.unit}" if experiment.unit else ""
    lines = ["| | " + " | ".join(names) + " | mean |", "|" + "---|" * (len(names) + 2)]
    for side in experiment.sides:
        own = ours.get((side.variant, experiment.score), {})
        cells = [_cell(own.get(name), side.paper.get(name), digits) for name in names]
        shared = [name for name in names if name in own and (name in side.paper or not side.paper)]
        mean = _mean([own[name] for name in shared])
        paper = _mean([side.paper[name] for name in shared]) if side.paper else None
        lines.append("| " + " | ".join([side.name, *cells, _cell(mean, paper, digits)]) + " |")
    note = experiment.note.format(
        ratio="–" if ratio is None else f"{marked(f'{ratio:.2f}', f'{record_name(experiment)}.iteration_ratio')} times"
    )
    parts = [
        f"## {experiment.title}",
        f"Source: {experiment.source}." + (f" Score:{unit}." if unit else ""),
        marked_table("\n".join(lines), record_name(experiment)),
        note,
    ]
    return "\n\n".join(part for part in parts if part)


def record_name(experiment: Experiment) -> str:
    """Returns the name of the record of an experiment's table.

    >>> record_name(EXPERIMENTS[0])
    'paper-online-comparison-psnr'
    """
    return "paper-" + "-".join(re.findall(r"\w+", experiment.title.partition(":")[0].lower()))


def summary(outcomes: Sequence[ClaimResult], by_title: Mapping[str, Sequence[ClaimResult]]) -> str:
    """Returns the numbers of claims that agree, disagree or are not measured, and a Markdown table of all claims."""
    known = [outcome for outcome in outcomes if outcome.agrees != "not measured"]
    counts = {word: sum(o.agrees == word for o in known) for word in ("sign and size", "sign", "no")}
    rows: list[Row] = []
    for experiment in EXPERIMENTS:
        form = f"+.{DIGITS[experiment.score]}f"
        for outcome in by_title[experiment.title]:
            claim, measured = outcome.claim, outcome.own is not None
            rows.append(
                {
                    "experiment": experiment.title,
                    "claim": claim.what,
                    "comparison": f"{claim.first} – {claim.second}",
                    "ours": None if outcome.own is None else format(outcome.own, form),
                    "paper": None if outcome.paper is None else format(outcome.paper, form),
                    "agreement": "**none**" if outcome.agrees == "no" else outcome.agrees,
                    "agreeing captures": f"{outcome.same_sign} of {len(outcome.captures)}" if measured else None,
                }
            )
    named = {
        "comparisons": len(outcomes),
        "sign_and_size": counts["sign and size"],
        "sign": counts["sign"],
        "none": counts["no"],
        "not_measured": len(outcomes) - len(known),
    }
    words = {name: marked(str(count), f"{AGREEMENT}.{name}") for name, count in named.items()}
    return (
        f"Of {words['comparisons']} comparisons, {words['sign_and_size']} agree in sign and size,\n"
        f"{words['sign']} only in sign, {words['none']} disagree,\n"
        f"and {words['not_measured']} are not measured.\n\n"
        + marked_table(markdown(rows, [Column(name, name) for name in rows[0]]), AGREEMENT)
    )


def _commands(captures: Sequence[str], there: Sequence[str], page: Path) -> str:
    """Returns the commands that measure the rows and write the page."""
    command = "scripts/bench paper " + " ".join(f"CAPTURES/{name}" for name in there)
    more = " ".join(f"CAPTURES/{name}" for name in captures if name not in there)
    if not more:
        return f"{command} --page docs/{page.name}"
    return f"{command}\n{command} {more} --no-measure --page docs/{page.name}"


def _elsewhere(captures: Sequence[str], there: Sequence[str]) -> str:
    """Describes the source of figures for captures without rows in the study."""
    others = [name for name in captures if name not in there]
    if not others:
        return ""
    names = ", ".join(others)
    return f" For {names}, the PSNR comes from [quality.md](quality.md), over the updates that both methods cover."


def needed() -> list[Variant]:
    """Returns the settings that the experiments compare, without duplicates."""
    return list(dict.fromkeys(side.variant for experiment in EXPERIMENTS for side in experiment.sides))


def _cell(own: float | None, paper: float | None, digits: int) -> str:
    mine = "–" if own is None else f"{own:.{digits}f}"
    return mine if paper is None else f"{mine} ({paper:g})" if digits != 2 else f"{mine} ({paper:.2f})"


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _provenance(out: Path, captures: Sequence[str]) -> str:
    rows = [row for row in Store(out).rows() if "error" not in row and row["capture"] in captures]
    when, machines, cores = provenance(rows)
    older = ""
    if cores != core_version():
        older = (
            ", with earlier versions of the method\n([accuracy-and-time.md](accuracy-and-time.md) has newer figures)"
        )
    return f"Measured: {marked_days(when, AGREEMENT)}{older}.\nMachine: `{machines}`."
