"""Targets of a simulation, and the table of its results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from studies.simulation.delays import WAIT_S
from studies.simulation.simulate import Outcome

SOON_S, SHARE = 10.0, 0.99
"""Target: a fraction `SHARE` of the workers is placed within `SOON_S` seconds, counted only while a node has room."""
REASONS = {"new": "of a new scene", "loss": "after a loss", "restart": "after a restart of the service"}
AFTER = {"node": "a node's failure", "worker": "a worker's end", "service": "the service's end"}


@dataclass(frozen=True)
class Row:
    """A row of the table: a figure, and its target if it has one."""

    what: str
    found: str
    target: str = ""
    reached: bool = True


def rows(outcome: Outcome) -> list[Row]:
    """Compares an outcome with the targets and returns the rows of the table."""
    frames = outcome.frames
    seconds = [times for table_rows in outcome.placed.values() for times in table_rows]
    share = _share([room for room, _ in seconds])
    table_rows = [
        _none("acknowledged frames lost", frames.lost, f" of {frames.read + frames.lost:,}"),
        _none("frames run twice", frames.twice),
        _none(
            "workers started while another worker of their scene was running", frames.beside, f" of {outcome.workers:,}"
        ),
        _none(
            "frames read that an abandoned worker wrote",
            frames.foreign,
            f"; such workers wrote {outcome.adrift:,} files",
        ),
        _none("frames read that differ from an undisturbed run", frames.different),
        Row(
            f"workers placed within {SOON_S:g} s while a node has room",
            f"{share:.2%} of {len(seconds):,}",
            f"≥ {SHARE:.0%}",
            share >= SHARE,
        ),
    ]
    for reason, words in REASONS.items():
        if times := outcome.placed.get(reason):
            room, answered = (_share(each) for each in zip(*times, strict=True))
            share_of = f"{room:.2%} of {len(times):,}; while the head responds {answered:.2%}"
            table_rows.append(Row(f"… {words}", share_of))
    longest = max(outcome.waited, default=0.0)
    table_rows += [
        _none(
            f"workers unplaced for {WAIT_S:g} s whose scene reports no reason",
            outcome.unexplained,
            f" of {len(outcome.waited):,}",
        ),
        _none(
            "scenes without a worker at the end",
            outcome.unplaced,
            f"; {outcome.sizes.more:,} were requested beyond the capacity, the longest wait was {longest:.0f} s",
        ),
        _none("folders of earlier workers left at the end", outcome.folders),
        Row("frames updated again after a commit that was not reported", f"{frames.again:,}"),
    ]
    for failure, words in AFTER.items():
        if times := outcome.resumed.get(failure):
            table_rows.append(Row(f"from {words} until the scene continues, while a node has room", _seconds(times)))
    return table_rows


def summarize(outcome: Outcome) -> str:
    """Formats an outcome as a sentence on the failures and a Markdown table."""
    sizes = outcome.sizes
    kinds = ", ".join(f"{kind} {count}" for kind, count in sorted(outcome.happened.items()))
    lines = [
        f"{sizes.scenes:,} scenes on {sizes.nodes:,} nodes of {sizes.cpus} CPUs, seed {sizes.seed}: "
        f"{sum(outcome.happened.values()):,} failures ({kinds}) in {outcome.seconds / 3600:.1f} simulated hours.",
        "",
        "| | target | found | |",
        "|---|---|---|---|",
    ]
    for row in rows(outcome):
        verdict = "" if not row.target else "reached" if row.reached else "**missed**"
        lines.append(f"| {row.what} | {row.target} | {row.found} | {verdict} |")
    return "\n".join(lines)


def _none(what: str, count: int, of: str = "") -> Row:
    return Row(what, f"{count:,}{of}", "0", count == 0)


def _share(seconds: Sequence[float]) -> float:
    return sum(each <= SOON_S for each in seconds) / max(1, len(seconds))


def _seconds(times: Sequence[tuple[float, float]]) -> str:
    with_room = sorted(total - without for total, without in times)
    late = with_room[int(0.99 * (len(with_room) - 1))]
    longest = max(total for total, _ in times)
    return (
        f"median {median(with_room):.1f} s, 99% {late:.1f} s, maximum {with_room[-1]:.1f} s; "
        f"including waits for a node, maximum {longest:.0f} s"
    )
