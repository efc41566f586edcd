"""Page of the variants study: gains of the contenders."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from client.cli.scores import Row

BEHIND_DB = -0.05
"""Gain in dB below which a contender counts as behind. Smaller losses are within the spread over seeds."""

Place = tuple[str, str]
"""A capture and one of its variants."""
Figures = dict[tuple[Place, str], list[Row]]
"""Maps each place and contender to its rows for all seeds."""


def page(rows: Sequence[Row], contenders: Sequence[str]) -> str:
    """Formats the results as Markdown tables.

    Args:
        rows: rows with ``capture``, ``of``, ``contender`` and ``seed``; failed rows have ``error``.
        contenders: contender names; the first is the baseline.
    """
    figures: Figures = {}
    for row in rows:
        if "error" not in row and row.get("updates"):
            figures.setdefault(((row["capture"], row["of"]), row["contender"]), []).append(row)
    first, others = contenders[0], contenders[1:]
    places = [place for place in dict.fromkeys(place for place, _ in figures) if (place, first) in figures]
    head = [f"{name}: dB more; time; tracks" for name in others]
    lines = [
        "| " + " | ".join(["capture", "variant", f"frame 0 dB, {first}", f"{first} dB", "tracks %", *head]) + " |",
        "|" + "---|" * (5 + len(others)),
    ]
    for place in places:
        base = figures[place, first]
        cells = [f"{mean(base, 'psnr_first'):.2f}", f"{mean(base, 'psnr'):.2f}{_spread(base)}", _tracks(base)]
        cells += [_against(figures.get((place, name), []), base) for name in others]
        lines.append("| " + " | ".join([*place, *cells]) + " |")
    for name in others:
        both = [place for place in places if (place, name) in figures]
        if not both:
            continue
        gains = np.array([gain(figures, place, name, first) for place in both])
        times = [ratio(figures[place, name], figures[place, first]) for place in both]
        worst = int(gains.argmin())
        lines += [
            "",
            f"**{name}**: {gains.mean():+.2f} dB at {np.exp(np.mean(np.log(times))):.2f} × the time; "
            f"not behind on {np.mean(gains > BEHIND_DB):.0%} of {len(both)}; "
            f"worst {gains[worst]:+.2f} dB ({', '.join(both[worst])}).",
        ]
    return "\n".join(lines)


def gain(figures: Figures, place: Place, name: str, first: str) -> float:
    """Returns the lead in dB of a contender over the first one, averaged over seeds and updates."""
    return mean(figures[place, name], "psnr") - mean(figures[place, first], "psnr")


def ratio(rows: Sequence[Row], base: Sequence[Row]) -> float:
    """Returns the time of an update relative to the time in other rows."""
    return mean(rows, "seconds_update") / mean(base, "seconds_update")


def mean(rows: Sequence[Row], name: str) -> float:
    """Returns the mean of a value over rows."""
    return float(np.mean([row[name] for row in rows]))


def _spread(rows: Sequence[Row]) -> str:
    return f" ± {np.std([row['psnr'] for row in rows], ddof=1):.2f}" if len(rows) > 1 else ""


def _tracks(rows: Sequence[Row]) -> str:
    return f"{mean(rows, 'track_3d_median'):.2f}" if all("track_3d_median" in row for row in rows) else "–"


def _against(rows: Sequence[Row], base: Sequence[Row]) -> str:
    if not rows:
        return "–"
    more = mean(rows, "psnr") - mean(base, "psnr")
    return f"{more:+.2f}{_spread(rows)}; {ratio(rows, base):.2f}; {_tracks(rows)}"
