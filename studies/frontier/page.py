"""The frontier page: plots, advice, the comparison at equal time, and the underlying tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import log2
from pathlib import Path

from client.cli.scores import Column, Row, Store, markdown
from studies.frontier import plots
from studies.frontier.frontier import AXES, DEFAULT, METHODS, UPDATES, Variant
from studies.frontier.timing import read_times
from studies.frontier.tradeoff import (
    EqualSeconds,
    Point,
    curve,
    equal_seconds,
    mean_points,
    of_axis,
    read_points,
    undominated,
)
from studies.machine import provenance
from studies.marks import marked, marked_days, marked_table

PREVIEW_LOSS_DB = 4.0
"""Largest PSNR loss allowed for a preview, relative to the default."""
LIVE_GAIN_DB = 1.0
"""PSNR that each doubling of the time must gain for a live show to use a slower setting."""
ARCHIVE_GAIN_DB = 0.1
"""Largest PSNR loss allowed for an archive, relative to the best setting. The fastest such setting is used."""
STAGE_ROWS = ("scas4d 10", "scas4d 25", "scas4d 50", "scas4d 100", "dynamic3dgs 100", "dynamic3dgs 200")
"""Labels of the settings whose stages are plotted."""
AXIS_WORDS: Mapping[str, str] = {
    "adaptive": "Other presets",
    "layers": "Number of layers (K)",
    "clusters": "First-layer clusters",
    "views": "Views per iteration",
    "max-scale": "Maximum scale",
    "covariance": "Covariance",
}
COLUMNS = (
    Column("PSNR dB", "psnr", ".2f"),
    Column("fg dB", "psnr_foreground", ".2f"),
    Column("SSIM", "ssim", ".4f"),
    Column("FLIP", "flip", ".4f"),
    Column("3D %", "track_3d_median", ".2f"),
    Column("2D %", "mte_2d", ".2f"),
    Column("parts ARI", "parts_ari", ".3f"),
)
"""Columns of the score table that show scores."""
CHOICE = (
    Column("use", "use"),
    Column("setting", "setting"),
    Column("s/frame", "seconds"),
    Column("PSNR dB", "psnr"),
    Column("vs. default", "against"),
    Column("3D %", "track_3d_median"),
    Column("parts ARI", "parts_ari", ".3f"),
)
"""Columns of the table of recommended settings."""


ITERATIONS, EQUAL = "accuracy-iterations", "accuracy-equal-time"
"""Names of the records of the tables that compare iterations, and the methods at equal time."""


class NothingMeasured(ValueError):
    """Raised if the study has no rows for the captures."""


def write_page(out: Path, captures: Sequence[str], page: Path, updates: int = UPDATES) -> str:
    """Draws the plots into a folder named after the page and writes the page, with marked figures.

    Args:
        out: study folder.
        captures: capture names; captures without rows are left out.
        page: Markdown file to write.
        updates: number of updates that the rows cover.

    Returns:
        The text of the page.

    Raises:
        NothingMeasured: no capture has rows of both methods.
    """
    points = read_points(out, captures, updates)
    there = [name for name in captures if all(curve(points, method, name) for method in METHODS)]
    if not there:
        raise NothingMeasured(f"{out} has no rows of {', '.join(captures)}; run scripts/bench frontier on them first")
    means = mean_points(points, there)
    _draw(points, means, there, page.with_suffix(""), updates)
    text = _text(out, points, means, there, page.stem, updates)
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(text)
    return text


def chosen(means: Sequence[Point]) -> dict[str, Point]:
    """Returns one setting each for a preview, a live show and an archive, selected by the rules on the page.

    Args:
        means: points of every setting, on one capture or averaged; the default must be among them.
    """
    best = undominated(means)
    default = next(point for point in means if point.variant == DEFAULT)
    preview = next(point for point in best if point.psnr >= default.psnr - PREVIEW_LOSS_DB)
    live = preview
    for point in best[best.index(preview) + 1 :]:
        doublings = log2(point.seconds / live.seconds)
        if point.psnr - live.psnr >= LIVE_GAIN_DB * doublings:
            live = point
    archive = next(point for point in best if point.psnr >= best[-1].psnr - ARCHIVE_GAIN_DB)
    return {"preview": preview, "live show": live, "archive": archive}


def score_table(points: Sequence[Point], default: Point | None = None) -> str:
    """Returns a Markdown table with one row per point.

    Args:
        points: points in the order of the rows.
        default: point to which times are relative; if None, no relative times are shown.
    """
    rows: list[Row] = []
    for point in points:
        ratio = None if default is None else point.seconds / default.seconds
        rows.append({"setting": point.variant.label, "seconds": point.seconds, "ratio": ratio, **point.scores})
    head = (Column("setting", "setting"), Column("s/frame", "seconds"), Column("× default", "ratio"))
    return markdown(rows, (*head, *COLUMNS))


def equal_table(compared: Sequence[EqualSeconds]) -> str:
    """Returns a Markdown table of captures by budgets, whose cells show the lead and the PSNR of both methods."""
    rows: dict[str, Row] = {}
    for one in compared:
        rows.setdefault(one.capture, {"capture": one.capture})[str(one.iterations)] = _equal_cell(one)
    budgets = [Column(f"{count} iterations", str(count)) for count in sorted({one.iterations for one in compared})]
    return markdown(rows.values(), (Column("capture", "capture"), *budgets))


def equal_words(compared: Sequence[EqualSeconds]) -> str:
    """Returns a sentence on the number of budgets at which ``scas4d`` leads, and on its smallest lead."""
    leads = [one.lead for one in compared if one.lead is not None]
    missing = len(compared) - len(leads)
    if not leads:
        return "Not measured at a common time."
    ahead = sum(lead > 0 for lead in leads)
    named = {"ahead": str(ahead), "budgets": str(len(leads)), "smallest": f"{min(leads):+.2f}", "missing": str(missing)}
    words = {name: marked(text, f"{EQUAL}.{name}") for name, text in named.items()}
    text = f"`scas4d` is ahead at {words['ahead']} of {words['budgets']} budgets;\n"
    text += f"the smallest lead is {words['smallest']} dB."
    return text + (f" The measured range does not include the other {words['missing']}." if missing else "")


def _draw(points: Sequence[Point], means: Sequence[Point], captures: Sequence[str], folder: Path, updates: int) -> None:
    """Draws the plots into a folder."""
    words = f"mean of {', '.join(captures)}; first {updates} updates"
    plots.draw_frontier(means, words, folder / "frontier.png")
    plots.draw_captures(points, captures, folder / "captures.png")
    bars = [p for label in STAGE_ROWS for p in means if p.variant.label == label]
    plots.draw_stages(bars, words, folder / "stages.png")


def _text(
    out: Path,
    points: Sequence[Point],
    means: Sequence[Point],
    captures: Sequence[str],
    stem: str,
    updates: int,
) -> str:
    default = next(point for point in means if point.variant == DEFAULT)
    iterations = [point for method in METHODS for point in curve(means, method)]
    compared = equal_seconds(points, captures)
    others = "\n\n".join(
        f"**{words}**{_over(points, axis, captures)}\n\n"
        + marked_table(score_table(axis_means, base), f"accuracy-{axis}")
        for axis, words in AXIS_WORDS.items()
        for axis_means, base in [_axis_means(points, axis, captures)]
        if axis_means
    )
    return f"""# Accuracy against time

![frontier]({stem}/frontier.png)

{_provenance(out, captures)}

An iteration is a forward and backward pass over one training view, or over several where noted. Each row covers the
first {updates} updates of a capture, starting from the same frame 0. Accuracy is averaged over these updates and the
test cameras. Metrics are defined in `scas4d_core/metrics/`, as in [quality.md](quality.md). Times are medians per
update, including decoding and commit. Because the machine is shared, times on other pages differ. A setting is
dominated if another is at least as fast and more accurate.

## Recommended settings

{marked_table(_choice(means, default), "accuracy-recommended")}

Selection rules:

- preview: the fastest setting within `{PREVIEW_LOSS_DB:g} dB` of the default;
- live show: the slowest setting for which each doubling of the time gains at least `{LIVE_GAIN_DB:g} dB`;
- archive: the fastest setting within `{ARCHIVE_GAIN_DB:g} dB` of the best.

## Comparison at equal time

Each budget is the time in which the baseline, `dynamic3dgs`, completes a number of iterations. The PSNR of `scas4d` at
that time is interpolated linearly in log time between measured settings. Settings that are slower and less accurate
than another are omitted. Cells show the lead of `scas4d` in dB and both PSNR values (`scas4d` : baseline).
{equal_words(compared)}

{marked_table(equal_table(compared), EQUAL)}

![captures]({stem}/captures.png)

## Iterations

{marked_table(score_table(iterations, default), ITERATIONS)}

With 10 iterations, updates miss motion. Fitting the missed motion as new objects takes longer than the saved iterations
(*rest* in the stage plot).

## One setting at a time

Each row changes one setting of the default (`scas4d`, 100 iterations).

{others}

## Stages

Time per frame, by stage.

![stages]({stem}/stages.png)

## How it was measured

```
scripts/bench frontier {" ".join(f"CAPTURES/{name}" for name in captures)} --page docs/{stem}.md
```

Times come from a separate pass (`--only times`) that alternates between all settings.
"""


def _choice(means: Sequence[Point], default: Point) -> str:
    rows: list[Row] = []
    for purpose, point in chosen(means).items():
        gain, ratio = point.psnr - default.psnr, point.seconds / default.seconds
        words = {"use": purpose, "setting": point.variant.label, "against": f"{gain:+.2f} dB, {ratio:.2f}× the time"}
        rows.append({**words, "seconds": point.seconds, **point.scores})
    return markdown(rows, CHOICE)


def _axis_means(points: Sequence[Point], axis: str, captures: Sequence[str]) -> tuple[list[Point], Point | None]:
    """Returns the means of the default and of an axis, over the captures on which the axis was measured."""
    on = _captures_of(points, axis, captures)
    if not on:
        return [], None
    means = mean_points(points, on)
    default = next(point for point in means if point.variant == DEFAULT)
    return [default, *of_axis(means, axis)], default


def _captures_of(points: Sequence[Point], axis: str, captures: Sequence[str]) -> list[str]:
    """Returns the captures on which the complete axis was measured."""
    needed = set(AXES[axis])

    def has(capture: str) -> set[Variant]:
        return {point.variant for point in points if point.capture == capture}

    return [capture for capture in captures if needed and needed <= has(capture)]


def _over(points: Sequence[Point], axis: str, captures: Sequence[str]) -> str:
    on = _captures_of(points, axis, captures)
    return "" if len(on) == len(captures) else f" (mean of {', '.join(on)})"


def _provenance(out: Path, captures: Sequence[str]) -> str:
    rows = [row for row in Store(out).rows() if "error" not in row and row["capture"] in captures]
    times = [row for name in captures if (row := read_times(out, name)) is not None]
    when, _, cores = provenance([*rows, *times])
    where = f"`{provenance(times)[1]}`" if times else "not timed separately; CPU seconds of single-threaded rows"
    return (
        f"- Measured: {marked_days(when, ITERATIONS)}.\n"
        f"- Machine for times: {where}.\n- Machine for accuracy: `{provenance(rows)[1]}`.\n"
        f"- Source versions of the core: {cores}."
    )


def _equal_cell(one: EqualSeconds) -> str:
    if one.psnr is None or one.lead is None:
        return "–"
    return f"{one.lead:+.2f} ({one.psnr:.2f} : {one.baseline_psnr:.2f}) at {one.seconds:.2f} s"
