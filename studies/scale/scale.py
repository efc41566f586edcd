"""``scripts/bench scale``: time and memory as one size at a time grows. Each size runs in a separate process."""

from __future__ import annotations

import resource
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np

from client.cli.evaluate import Report
from client.cli.scores import Column, Row, digest, markdown
from scas4d_core.captures import InitialPoints
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from studies.apart import in_a_process
from studies.rows import kept_row
from studies.wall import Size, known, rig, shown, wall

SCENE = {"metres_per_unit": 1.0, "background": (0.0, 0.0, 0.0)}
"""Scene settings of the footage. With another background, static Gaussians would look wrong and be corrected."""
ITERATIONS = 100
"""Iterations per update at every size, as in the paper, and iterations of frame 0."""
UPDATES = 4
"""Number of updates. The first one searches for the motion and is not counted."""
PIXELS = ((256, 256), (512, 512), (1280, 720), (1920, 1080))
SWEEPS: Mapping[str, Sequence[Size]] = {
    "Gaussians": [Size(gaussians=count) for count in (5_000, 20_000, 50_000, 100_000, 200_000, 500_000)],
    "pixels": [Size(width=wide, height=high, cameras=6) for wide, high in PIXELS],
    "pixels, all of which move": [Size(width=wide, height=high, cameras=6, moving=1.0) for wide, high in PIXELS],
    "cameras": [Size(cameras=count) for count in (4, 8, 16, 32, 64, 100)],
    "share that moves": [Size(moving=share) for share in (0.05, 0.1, 0.2, 0.4, 0.8)],
}
"""Sizes of each sweep, keyed by the quantity that grows. Everything else is as in ``Size()``."""
COSTS = (
    Column("update, s", "update"),
    Column("view, ms", "view", ".0f"),
    Column("frame 0, s", "frame_0"),
    Column("memory, MB", "memory", ".0f"),
)


def amount(name: str, size: Size) -> float:
    """Returns the quantity that varies in the sweep ``name``, for one of its sizes."""
    if name.startswith("pixels"):
        return float(size.width * size.height)
    return float({"Gaussians": size.gaussians, "cameras": size.cameras, "share that moves": size.moving}[name])


def slope(amounts: Sequence[float], costs: Sequence[float]) -> float:
    """Returns the exponent of the cost: the least-squares slope in a log-log plot.

    >>> round(slope([1, 10, 100], [2, 20, 200]), 6)
    1.0
    """
    return float(np.polyfit(np.log(amounts), np.log(costs), 1)[0])


def cost(size: Size) -> Row:
    """Measures one size in this process.

    Returns:
        ``update``, median seconds per update; ``view``, median ms per view; ``frame_0``, seconds to fit frame 0 from
        its images and one point per Gaussian; ``memory``, peak MB of the process during updates and views.
    """
    static = {"iterations": ITERATIONS, "max_gaussians": size.gaussians}
    settings = Settings.model_validate({"scene": SCENE, "static": static, "update": {"iterations": ITERATIONS}})
    state, cameras = wall(size), rig(size)
    frames = [shown(state, index, cameras) for index in range(UPDATES + 1)]
    scene = Reconstruction.start(cameras, frames[0], settings, static=known(state, cameras))
    seconds, views = [], []
    for frame in frames[1:]:
        began = perf_counter()
        scene.step(frame)
        seconds.append(perf_counter() - began)
        began = perf_counter()
        scene.render(cameras.cameras[0])
        views.append(1e3 * (perf_counter() - began))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    points = InitialPoints(state.means.astype(np.float64), state.colours, state.foreground)
    began = perf_counter()
    Reconstruction.start(cameras, frames[0], settings, points=points)
    first = perf_counter() - began
    return {"update": median(seconds[1:]), "view": median(views[1:]), "frame_0": first, "memory": memory}


def run(work: Path, sweeps: Sequence[str], echo: Report) -> dict[str, list[Row]]:
    """Measures the sizes that are not in the folder ``work``, and returns the costs of each sweep."""
    found: dict[str, list[Row]] = {}
    for name in sweeps:
        for size in SWEEPS[name]:
            path = work / f"{digest(asdict(size), SCENE, ITERATIONS, UPDATES)}.json"
            found.setdefault(name, []).append(kept_row(path, partial(in_a_process, cost, size)))
            echo(f"{name} {amount(name, size):g}: {found[name][-1]}")
    return found


def summarize(found: Mapping[str, Sequence[Row]]) -> str:
    """Formats the costs and their exponents as Markdown tables."""
    tables = []
    for name, costs in found.items():
        amounts = [amount(name, size) for size in SWEEPS[name]]
        rows: list[Row] = [{"size": f"{size:,.10g}"} | one for size, one in zip(amounts, costs, strict=True)]
        slopes = {c.name: f"**{slope(amounts, [one[c.name] for one in costs]):.2f}**" for c in COSTS}
        tables.append(markdown([*rows, {"size": "**exponent**", **slopes}], (Column(name, "size"), *COSTS)))
    return "\n\n".join(tables)
