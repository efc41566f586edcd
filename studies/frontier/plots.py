"""Plots of the frontier as PNG files: accuracy against time, and time per stage.

Each plot is as wide as a column (``COLUMN``) or a page (``PAGE``) of a paper, with text of 6.5 to 8 points at that
width. The palette of Okabe and Ito is distinguishable with any colour vision, and shapes and labels carry the same
information. In all plots, a colour denotes the same method, axis or stage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from scas4d_core.engines.engine import REPORT
from studies.frontier.frontier import DEFAULT, METHODS
from studies.frontier.tradeoff import Point, curve, of_axis, undominated

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#F0E442", "#000000")
COLOURS = dict(zip(METHODS, OKABE_ITO, strict=False))
MARKERS = dict(zip(METHODS, "os", strict=False))
OTHER_AXES = {
    "layers": ("layers K", "s", OKABE_ITO[2]),
    "clusters": ("first-layer clusters N", "D", OKABE_ITO[3]),
    "views": ("views per iteration", "X", "#882255"),
    "covariance": ("covariance", "P", "#661100"),
    "adaptive": ("other presets", "*", OKABE_ITO[7]),
}
"""Name, marker and colour of each axis."""
STAGES = {
    "render backward": "#332288",
    "render": "#88CCEE",
    "picture loss": "#44AA99",
    "cascade backward": "#117733",
    "cascade": "#999933",
    "neighbours": "#DDCC77",
    "adam": "#CC6677",
    "decode": "#882255",
    "start": "#AA4499",
    "end": "#661100",
    "judge": "#6699CC",
    "iterations": "#44AA99",
    REPORT: "#000000",
    "rest": "#BBBBBB",
}
"""Colours of the stages (Paul Tol's "muted"), distinct from those of the methods."""
ABOUT = (0.7, 1.6)
"""Range of times relative to the default. Settings within this range get a panel of their own."""
COLUMN, PAGE = 3.45, 7.0
"""Widths of the figures in inches."""
STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "axes.linewidth": 0.7,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "savefig.dpi": 300,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.03,
    "figure.constrained_layout.use": True,
}
SECONDS = "seconds per frame"
PSNR = "PSNR on the test cameras (dB)"
SMALL_STAGES = 0.02
"""Fraction of the longest bar. Stages that are shorter than this in every bar are combined, except the report."""
SIDES = (
    *((5, 0, "left", "center"), (-5, 0, "right", "center"), (0, 4, "center", "bottom"), (0, -4, "center", "top")),
    *((5, 5, "left", "bottom"), (5, -5, "left", "top"), (-5, 5, "right", "bottom"), (-5, -5, "right", "top")),
    *((3, 11, "left", "bottom"), (3, -11, "left", "top"), (-3, 11, "right", "bottom"), (-3, -11, "right", "top")),
)
"""Candidate label positions: offset from the point in points, and alignments, in order of preference."""
FAR = 150
"""Cost of a label far from its point: more than crossing a line, less than hiding another label."""
LABEL_GAP = 8.5
"""Vertical distance between the centres of stacked labels, in points."""


def draw_frontier(points: Sequence[Point], title: str, file: Path) -> None:
    """Plots accuracy against time: both methods by iterations, and variations of the default settings.

    Args:
        points: points of one capture, or means over several.
        title: description of what was measured.
        file: PNG file to write.
    """
    plt = _pyplot()
    default = next((point for point in points if point.variant == DEFAULT), None)
    least, most = (0.0, inf) if default is None else (share * default.seconds for share in ABOUT)
    settings = [(axis, point) for axis in OTHER_AXES for point in of_axis(points, axis)]
    others: dict[str, list[Point]] = {}
    for axis, point in settings:
        if least <= point.seconds <= most:
            others.setdefault(axis, []).append(point)
    figure, grid = plt.subplots(
        1,
        1 + bool(others),
        figsize=(PAGE if others else COLUMN, 3.2),
        squeeze=False,
        width_ratios=[1, 1][: 1 + bool(others)],
    )
    axes = grid[0, 0]
    best = undominated([point for axis in ("iterations", *OTHER_AXES) for point in of_axis(points, axis)])
    shown = [_steps(axes, best)]
    shown += [_curve(axes, points, method, best) for method in METHODS]
    for method in METHODS:
        for point in curve(points, method):
            where, side = ((-3, 4), "right") if method == METHODS[0] else ((4, -8), "left")
            axes.annotate(
                f"{point.variant.iterations}", (point.seconds, point.psnr), xytext=where, textcoords="offset points",
                fontsize=7, color=COLOURS[method], ha=side,
            )  # fmt: skip
    far = [(point, *OTHER_AXES[axis][1:]) for axis, point in settings if not least <= point.seconds <= most]
    for point, marker, colour in far:
        _markers(axes, [point], best, marker, colour, 20)
    _log_seconds(axes)
    axes.margins(y=0.07)
    axes.set_ylabel(PSNR)
    axes.set_title("a  by iterations per update (numbers)", loc="left")
    axes.legend(handles=shown, loc="lower right", handletextpad=0.5, borderaxespad=0.2)
    _name(axes, [(p.seconds, p.psnr, p.variant.label, c) for p, _, c in far], [one.get_data() for one in axes.lines])
    if others:
        _draw_about_default(plt, grid[0, 1], points, others, best)
    figure.suptitle(f"{title}; hollow: dominated", fontsize=7.5, color="#555555")
    _save(plt, figure, file)


def _draw_about_default(
    plt: Any, axes: Any, points: Sequence[Point], others: Mapping[str, list[Point]], best: Sequence[Point]
) -> None:
    """Plots the variations of one setting at a time with labels, and the curve through the default."""
    method = METHODS[0]
    _steps(axes, best)
    _curve(axes, points, method, best)
    default = next((point for point in points if point.variant == DEFAULT), None)
    named = [(point, OTHER_AXES[axis][2]) for axis, rows in others.items() for point in rows]
    for axis, rows in others.items():
        _, marker, colour = OTHER_AXES[axis]
        _markers(axes, rows, best, marker, colour, 20)
    if default is not None:
        named.insert(0, (default, COLOURS[method]))
    seconds, psnr = [point.seconds for point, _ in named], [point.psnr for point, _ in named]
    axes.set_xlim(min(seconds) / 1.27, max(seconds) * 1.16)
    room = 0.12 * (max(psnr) - min(psnr)) + 0.1
    axes.set_ylim(min(psnr) - room, max(psnr) + room)
    axes.set_xlabel(SECONDS)
    axes.set_title("b  one setting at a time around the default", loc="left")
    keys = [
        _key(plt, OTHER_AXES[axis][1], OTHER_AXES[axis][2], OTHER_AXES[axis][0])
        for axis in others
        if len(others[axis]) > 1
    ]
    axes.legend(handles=keys, loc="lower right", handletextpad=0.3, borderaxespad=0.2, labelspacing=0.3)
    avoided = [line.get_data() for line in axes.lines]
    words = {DEFAULT: f"{DEFAULT.iterations}"}
    _name(axes, [(p.seconds, p.psnr, words.get(p.variant, p.variant.label), colour) for p, colour in named], avoided)


def draw_captures(points: Sequence[Point], captures: Sequence[str], file: Path) -> None:
    """Plots both methods by iterations, with one panel per capture."""
    plt = _pyplot()
    columns = min(3, len(captures))
    rows = -(-len(captures) // columns)
    figure, grid = plt.subplots(
        rows, columns, figsize=(max(COLUMN, PAGE * columns / 3), 1.75 * rows + 0.2), squeeze=False, sharex=True
    )
    for capture, axes in zip(captures, grid.flat, strict=False):
        here = [point for point in points if point.capture == capture]
        for method in METHODS:
            _curve(axes, here, method, here, size=12)
        axes.set_title(capture, loc="left")
        _whole_decibels(axes)
        _log_seconds(axes, label=False)
    spare = list(grid.flat)[len(captures) :]
    for axes in spare:
        axes.axis("off")
    handles = [_key(plt, MARKERS[m], COLOURS[m], f"{m}, by iterations", line=True) for m in METHODS]
    if spare:
        spare[0].legend(handles=handles, loc="center", borderaxespad=0)
    else:
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
    for column in range(columns):
        last = max(row for row in range(rows) if row * columns + column < len(captures))
        grid[last, column].set_xlabel(SECONDS)
        grid[last, column].tick_params(labelbottom=True)
    figure.supylabel(PSNR, fontsize=8)
    _save(plt, figure, file)


def draw_stages(points: Sequence[Point], title: str, file: Path) -> None:
    """Plots the time of a frame by stage, with one bar per setting.

    Args:
        points: points in the order of the bars, the first on top.
        title: description of what was measured.
        file: PNG file to write.
    """
    plt = _pyplot()
    stages = _grouped_stages(points)
    figure, axes = plt.subplots(figsize=(PAGE, 0.27 * len(points) + 1.1))
    left = [0.0] * len(points)
    for name, seconds in stages.items():
        widths = [1000 * value for value in seconds]
        axes.barh(
            range(len(points)), widths, left=left, height=0.66, edgecolor="white", linewidth=0.5, label=name,
            color=STAGES.get(name, "#777777"),
        )  # fmt: skip
        left = [a + b for a, b in zip(left, widths, strict=True)]
    for number, whole in enumerate(left):
        axes.annotate(
            f"{whole:,.0f} ms", (whole, number), xytext=(4, 0), textcoords="offset points", va="center", fontsize=7.5
        )
    axes.set_yticks(range(len(points)), [p.variant.label for p in points])
    axes.tick_params(axis="y", length=0)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0, 1.1 * max(left))
    axes.set_xlabel("milliseconds per frame")
    axes.set_title(title, loc="left", fontsize=7.5, color="#555555")
    figure.legend(loc="outside lower center", ncols=5, handlelength=1.0, columnspacing=1.2)
    _save(plt, figure, file)


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    plt: Any = pyplot
    plt.rcParams.update(STYLE)
    return plt


def _save(plt: Any, figure: Any, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)
    plt.close(figure)


def _steps(axes: Any, best: Sequence[Point]) -> Any:
    """Draws the frontier in the background and returns its line."""
    (line,) = axes.step(
        [p.seconds for p in best], [p.psnr for p in best], where="post", color="#d4d4d4", linewidth=4, zorder=1,
        solid_capstyle="round", label="not dominated",
    )  # fmt: skip
    return line


def _curve(axes: Any, points: Sequence[Point], method: str, best: Sequence[Point], size: float = 24) -> Any:
    """Draws a method's curve over iterations and returns its legend entry."""
    line, colour = curve(points, method), COLOURS[method]
    axes.plot([p.seconds for p in line], [p.psnr for p in line], color=colour, linewidth=1.2, zorder=2)
    _markers(axes, line, best, MARKERS[method], colour, size)
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, marker=MARKERS[method], markersize=4, linewidth=1.2, label=method)


def _markers(axes: Any, points: Sequence[Point], best: Sequence[Point], marker: str, colour: str, size: float) -> None:
    """Draws filled markers for non-dominated points and hollow ones for the others."""
    axes.scatter(
        [p.seconds for p in points], [p.psnr for p in points], s=size, marker=marker, linewidths=1.0, zorder=3,
        facecolors=[colour if p in best else "white" for p in points], edgecolors=colour,
    )  # fmt: skip


def _key(plt: Any, marker: str, colour: str, words: str, line: bool = False) -> Any:
    """Returns a legend entry."""
    return plt.Line2D(
        [], [], linestyle="-" if line else "none", linewidth=1.2, marker=marker, color=colour, markersize=4, label=words
    )


def _log_seconds(axes: Any, label: bool = True) -> None:
    """Makes the time axis logarithmic. Without a label, the axis gets fewer ticks, as suits a small panel."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if label else (1, 3)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    if label:
        axes.set_xlabel(SECONDS)


def _whole_decibels(axes: Any) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, steps=[1, 2, 5, 10], integer=True))


def _name(axes: Any, named: Sequence[tuple[float, float, str, str]], avoided: Sequence[Any] = ()) -> None:
    """Labels each point on the side where its name hides the fewest points and lines.

    Args:
        axes: axes to draw on.
        named: x, y, name and colour of each point.
        avoided: lines to keep visible, as the x and y coordinates of their vertices.
    """
    from matplotlib.patheffects import withStroke
    from matplotlib.transforms import Bbox

    figure = axes.figure
    figure.draw_without_rendering()
    half = 3 * figure.dpi / 72
    legend = axes.get_legend()

    def around(point: tuple[float, float]) -> Any:
        across, up = axes.transData.transform(point)
        return Bbox.from_bounds(across - half, up - half, 2 * half, 2 * half)

    taken = [] if legend is None else [legend.get_window_extent()]
    taken += [text.get_window_extent() for text in axes.texts] + [around(one[:2]) for one in named]
    crossed = [around(point) for line in avoided for point in _along(line)]
    for x, y, words, colour in sorted(named, key=lambda one: -len(one[2])):  # long names first, while there is room
        tried = []
        for across, up, ha, va in SIDES:
            label = axes.annotate(
                words, (x, y), xytext=(across, up), textcoords="offset points", ha=ha, va=va, fontsize=6.5, zorder=6,
                color=colour, path_effects=[withStroke(linewidth=1.6, foreground="white")],
            )  # fmt: skip
            label.set_in_layout(False)
            box = label.get_window_extent()
            inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 and axes.bbox.y0 <= box.y0
            hidden = sum(box.overlaps(other) for other in taken) + 100 * (not inside)
            lines = sum(box.overlaps(other) for other in crossed)
            tried.append((1000 * hidden + lines + FAR * (abs(up) > LABEL_GAP), label, box))
        best = min(tried, key=lambda one: one[0])
        for one in tried:
            if one is not best:
                one[1].remove()
        taken.append(best[2])


def _along(line: tuple[Any, Any]) -> list[tuple[float, float]]:
    """Returns points along a line, including points between its vertices."""
    x, y = (np.asarray(values, float) for values in line)
    where = np.linspace(0, len(x) - 1, 20 * len(x))
    return list(zip(np.interp(where, range(len(x)), x), np.interp(where, range(len(y)), y), strict=True))


def _grouped_stages(points: Sequence[Point]) -> Mapping[str, list[float]]:
    """Returns the seconds of each stage per point, slowest stage first, with short stages combined as "rest"."""
    names = dict.fromkeys(name for point in points for name in point.stages)
    by_name = {name: [point.stages.get(name, 0.0) for point in points] for name in names}
    longest = max(sum(point.stages.values()) for point in points)
    ordered = sorted((name for name in by_name if name != REPORT), key=lambda name: -sum(by_name[name]))
    large = [name for name in ordered if max(by_name[name]) >= SMALL_STAGES * longest][:7]
    rest = [sum(by_name[name][i] for name in ordered if name not in large) for i in range(len(points))]
    own = {REPORT: by_name[REPORT]} if REPORT in by_name else {}
    return {**{name: by_name[name] for name in large}, "rest": rest, **own}
