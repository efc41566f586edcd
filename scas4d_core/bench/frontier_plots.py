"""The plots of the frontier, as PNG files: accuracy over time, within an update, over frames, and where the time goes.

Colours are those of Okabe and Ito, told apart with any colour vision; shapes and labels say the same again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scas4d_core.bench.frontier import METHODS
from scas4d_core.bench.store import Row
from scas4d_core.bench.tradeoff import Point, curve, of_axis, undominated

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#F0E442", "#000000")
COLOURS = dict(zip(METHODS, OKABE_ITO, strict=False))
OTHER_AXES = {
    "layers": ("number of layers K", "s", OKABE_ITO[2]),
    "clusters": ("clusters of the first layer N", "D", OKABE_ITO[3]),
    "pyramid": ("image pyramid", "^", OKABE_ITO[5]),
    "gaussians": ("budget of Gaussians", "v", OKABE_ITO[4]),
    "views": ("views per iteration", "X", "#882255"),
    "adaptive": ("other presets", "P", OKABE_ITO[7]),
}
"""In words, marker and colour."""
STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "savefig.dpi": 200,
    "savefig.bbox": "tight",
    "figure.constrained_layout.use": True,
}
SECONDS = "seconds per frame"
PSNR = "PSNR on the test cameras (dB)"
LINES = ("-", "--", ":")
SMALL_STAGES = 0.02
"""Of the longest bar: stages that are shorter in every bar are drawn as one."""


class PlotsMissing(RuntimeError):
    """matplotlib is not installed."""


def draw_frontier(points: Sequence[Point], title: str, file: Path) -> None:
    """Accuracy over seconds: both methods by iterations, the other axes around the default, who is not dominated.

    Args:
        points: of one capture, or means over several.
        title: what was measured.
        file: PNG.
    """
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(6.6, 4.2))
    best = undominated([point for axis in ("iterations", *OTHER_AXES) for point in of_axis(points, axis)])
    (frontier,) = axes.step(
        [p.seconds for p in best], [p.psnr for p in best], where="post", color="#c8c8c8", linewidth=5, zorder=1,
        solid_capstyle="round", label="not dominated (hollow: dominated)",
    )  # fmt: skip
    shown = [frontier]
    for method in METHODS:
        line = curve(points, method)
        axes.plot([p.seconds for p in line], [p.psnr for p in line], color=COLOURS[method], linewidth=1.4, zorder=2)
        _markers(axes, line, best, "o", COLOURS[method], 34)
        shown.append(_key(plt, "o", COLOURS[method], f"{method}, by iterations"))
        for point in line:
            where, side = ((-3, 5), "right") if method == METHODS[0] else ((4, -9), "left")
            axes.annotate(
                f"{point.variant.iterations}", (point.seconds, point.psnr), xytext=where, textcoords="offset points",
                fontsize=7, color=COLOURS[method], ha=side,
            )  # fmt: skip
    for axis, (words, marker, colour) in OTHER_AXES.items():
        if found := of_axis(points, axis):
            _markers(axes, found, best, marker, colour, 22)
            shown.append(_key(plt, marker, colour, words))
    _log_seconds(axes)
    axes.set_ylabel(PSNR)
    axes.set_title(title, loc="left")
    axes.legend(handles=shown, loc="lower right", handletextpad=0.5)
    _save(plt, figure, file)


def draw_captures(points: Sequence[Point], captures: Sequence[str], file: Path) -> None:
    """Both methods by iterations, a panel a capture."""
    plt = _pyplot()
    columns = min(3, len(captures))
    rows = -(-len(captures) // columns)
    figure, grid = plt.subplots(
        rows, columns, figsize=(0.5 + 2.1 * columns, 2.1 * rows + 0.2), squeeze=False, sharex=True
    )
    for capture, axes in zip(captures, grid.flat, strict=False):
        for method in METHODS:
            line = curve(points, method, capture)
            axes.plot(
                [p.seconds for p in line], [p.psnr for p in line], "o-" if method == METHODS[0] else "s--",
                color=COLOURS[method], linewidth=1.2, markersize=3.2, label=method,
            )  # fmt: skip
        axes.set_title(capture, loc="left")
        _log_seconds(axes, label=False)
    spare = list(grid.flat)[len(captures) :]
    for axes in spare:
        axes.axis("off")
    handles, labels = grid.flat[0].get_legend_handles_labels()
    if spare:
        spare[0].legend(handles, labels, loc="center")
    else:
        grid.flat[0].legend(handles, labels, loc="lower right")
    for column in range(columns):
        last = max(row for row in range(rows) if row * columns + column < len(captures))
        grid[last, column].set_xlabel(SECONDS)
        grid[last, column].tick_params(labelbottom=True)
    figure.supylabel(PSNR, fontsize=9)
    _save(plt, figure, file)


def draw_convergence(row: Row, file: Path) -> None:
    """The test cameras' PSNR within an update, what ``measure_convergence`` returned."""
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(5.6, 3.4))
    seen: dict[str, int] = {}
    for drawn in row["curves"]:
        style = LINES[seen.get(drawn["preset"], 0) % len(LINES)]
        seen[drawn["preset"]] = seen.get(drawn["preset"], 0) + 1
        colour = COLOURS.get(drawn["preset"], OKABE_ITO[7])
        axes.plot(drawn["iterations"], drawn["psnr"], style, color=colour, linewidth=1.5)
        axes.plot(drawn["iterations"][-1], drawn["psnr"][-1], "o", color=colour, markersize=4)
    longest = max(drawn["iterations"][-1] for drawn in row["curves"])
    for drawn in row["curves"]:
        end = drawn["iterations"][-1]
        colour = COLOURS.get(drawn["preset"], OKABE_ITO[7])
        _end_label(axes, end, drawn["psnr"][-1], drawn["label"], colour, below=end < longest)
    axes.set_xlabel("iterations done")
    axes.set_ylabel(PSNR)
    _room_for_labels(axes, longest, 1.3)
    axes.set_title(f"{row['capture']}, mean of the first {row['updates']} updates", loc="left")
    _save(plt, figure, file)


def draw_drift(points: Sequence[Point], capture: str, file: Path) -> None:
    """PSNR frame by frame through a whole capture."""
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(5.6, 3.4))
    seen: dict[str, int] = {}
    drift = of_axis(points, "drift", capture)
    for point in drift:
        method = point.variant.preset
        style = LINES[seen.get(method, 0) % len(LINES)]
        seen[method] = seen.get(method, 0) + 1
        axes.plot(range(len(point.psnr_by_frame)), point.psnr_by_frame, style, color=COLOURS[method], linewidth=1.5)
        _end_label(axes, len(point.psnr_by_frame) - 1, point.psnr_by_frame[-1], point.variant.label, COLOURS[method])
    axes.set_xlabel("frame")
    axes.set_ylabel(PSNR)
    _room_for_labels(axes, max(len(p.psnr_by_frame) for p in drift) - 1, 1.27)
    axes.set_title(capture, loc="left")
    _save(plt, figure, file)


def draw_stages(points: Sequence[Point], title: str, file: Path) -> None:
    """Where the time of a frame goes, a bar a setting.

    Args:
        points: in the order of the bars, the first on top.
        title: what was measured.
        file: PNG.
    """
    plt = _pyplot()
    stages = _grouped_stages(points)
    figure, axes = plt.subplots(figsize=(6.8, 0.36 * len(points) + 1.5))
    left = [0.0] * len(points)
    names = list(stages)
    for number, name in enumerate(names):
        widths = [1000 * seconds for seconds in stages[name]]
        axes.barh(
            range(len(points)), widths, left=left, height=0.62, edgecolor="white", linewidth=0.6, label=name,
            color=OKABE_ITO[number % len(OKABE_ITO)] if name != "rest" else "#b0b0b0",
        )  # fmt: skip
        left = [a + b for a, b in zip(left, widths, strict=True)]
    for number, whole in enumerate(left):
        axes.annotate(
            f"{whole:,.0f}", (whole, number), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8
        )
    axes.set_yticks(range(len(points)), [p.variant.label for p in points])
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0, 1.1 * max(left))
    axes.set_xlabel("milliseconds per frame")
    axes.set_title(title, loc="left")
    figure.legend(loc="outside lower center", ncols=5, handlelength=1.0, columnspacing=1.2)
    _save(plt, figure, file)


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError as error:
        raise PlotsMissing("plots need matplotlib; run pip install -e '.[bench]'") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    plt: Any = pyplot
    plt.rcParams.update(STYLE)
    return plt


def _save(plt: Any, figure: Any, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file)
    plt.close(figure)


def _markers(axes: Any, points: Sequence[Point], best: Sequence[Point], marker: str, colour: str, size: float) -> None:
    """Full markers for what is not dominated, hollow ones for the rest."""
    axes.scatter(
        [p.seconds for p in points], [p.psnr for p in points], s=size, marker=marker, linewidths=1.1, zorder=3,
        facecolors=[colour if p in best else "white" for p in points], edgecolors=colour,
    )  # fmt: skip


def _key(plt: Any, marker: str, colour: str, words: str) -> Any:
    """An entry of the legend."""
    return plt.Line2D([], [], linestyle="none", marker=marker, color=colour, markersize=5, label=words)


def _log_seconds(axes: Any, label: bool = True) -> None:
    """A logarithmic axis; without a label it is a small panel's, with fewer ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if label else (1, 3)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    if label:
        axes.set_xlabel(SECONDS)


def _end_label(axes: Any, x: float, y: float, words: str, colour: str, below: bool = False) -> None:
    axes.annotate(
        words, (x, y), xytext=(5, -8 if below else 0), textcoords="offset points", va="center", fontsize=8, color=colour
    )


def _room_for_labels(axes: Any, last: float, factor: float) -> None:
    """The axis goes on behind the last value, for the labels there, but its ticks do not."""
    from matplotlib.ticker import MaxNLocator

    axes.set_xticks([tick for tick in MaxNLocator(nbins=7, integer=True).tick_values(0, last) if tick <= last])
    axes.set_xlim(0, factor * last)


def _grouped_stages(points: Sequence[Point]) -> Mapping[str, list[float]]:
    """Seconds of each stage, one a point, the slowest stage first; short stages together as "rest"."""
    names = dict.fromkeys(name for point in points for name in point.stages)
    by_name = {name: [point.stages.get(name, 0.0) for point in points] for name in names}
    longest = max(sum(point.stages.values()) for point in points)
    ordered = sorted(by_name, key=lambda name: -sum(by_name[name]))
    large = [name for name in ordered if max(by_name[name]) >= SMALL_STAGES * longest][:7]
    rest = [sum(by_name[name][i] for name in ordered if name not in large) for i in range(len(points))]
    return {**{name: by_name[name] for name in large}, "rest": rest}
