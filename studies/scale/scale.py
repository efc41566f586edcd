"""``scripts/bench scale``: time and memory as one size at a time grows. Each size runs in a separate process."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any
from zlib import crc32

import numpy as np

from scas4d_core.captures import InitialPoints
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History
from studies.options import Echo
from studies.synthetic.wall import Size, known, rig, shown, wall

SCENE = {"metres_per_unit": 1.0, "background": (0.0, 0.0, 0.0)}
"""Scene settings of the footage. With another background, static Gaussians would look wrong and be corrected."""
ITERATIONS = 100
"""Iterations per update at every size, as in the paper."""
FIRST_ITERATIONS = 100
"""Iterations of frame 0."""
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
FRAMES = (100, 1_000, 10_000)
"""Numbers of frames after which the memory of one process is measured."""
TURN = 16
"""Number of frames after which the footage of the memory measurement reverses."""
KEPT = {"a folder": True, "the process": False}
"""Places where the memory measurement stores its states, mapped to whether the place is a folder."""


@dataclass(frozen=True)
class Cost:
    """Measurements of one size.

    Attributes:
        update: median seconds per update.
        view: median seconds per view.
        frame_0: seconds to fit frame 0 from its images and one point per Gaussian, with few iterations.
        memory: peak memory of the process in MB during updates and views, before frame 0 is fitted.
    """

    update: float
    view: float
    frame_0: float
    memory: float


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


def cost(size: Size) -> Cost:
    """Measures one size in this process and returns its cost."""
    settings = Settings.model_validate(
        {
            "scene": SCENE,
            "static": {"iterations": FIRST_ITERATIONS, "max_gaussians": size.gaussians},
            "update": {"iterations": ITERATIONS},
        }
    )
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
        views.append(perf_counter() - began)
    memory = _peak_mb()
    points = InitialPoints(state.means.astype(np.float64), state.colours, state.foreground)
    began = perf_counter()
    Reconstruction.start(cameras, frames[0], settings, points=points)
    return Cost(median(seconds[1:]), median(views[1:]), perf_counter() - began, memory)


def growth(frames: Sequence[int], *, folder: bool) -> dict[int, float]:
    """Runs a small scene in this process and returns its peak memory in MB, keyed by number of frames.

    Args:
        frames: numbers of frames after which the memory is measured.
        folder: whether states are stored in a folder, as in the service, or only in memory.
    """
    from tempfile import TemporaryDirectory

    size = Size(gaussians=2_000, width=64, height=64, cameras=4)
    settings = Settings.model_validate({"scene": SCENE, "update": {"iterations": 2}})
    state, cameras = wall(size), rig(size)
    there = [shown(state, way, cameras) for way in range(TURN + 1)]
    peak: dict[int, float] = {}
    with TemporaryDirectory() as work:
        history = History(Path(work) / "states") if folder else History()
        scene = Reconstruction.start(cameras, there[0], settings, static=known(state, cameras), history=history)
        for index in range(1, max(frames) + 1):
            way = index % TURN if index % (2 * TURN) < TURN else TURN - index % TURN  # back and forth
            scene.step(replace(there[way], index=index, time=index / 30))
            if index in frames:
                peak[index] = _peak_mb()
    return peak


def run(work: Path, sweeps: Sequence[str], frames: Sequence[int], echo: Echo) -> dict[str, Any]:
    """Measures the figures missing in ``work`` and returns all figures under the keys "sweeps" and "frames"."""
    work.mkdir(parents=True, exist_ok=True)
    for name in sweeps:
        for size in SWEEPS[name]:
            echo(f"{name} {amount(name, size):g}: {_kept(work, asdict(size))}")
    grown = {}
    for name, folder in KEPT.items() if frames else ():
        grown[name] = _kept(work, {"frames": list(frames), "folder": folder})
        echo(f"states in {name}: {grown[name]}")
    return {"sweeps": {name: [_kept(work, asdict(size)) for size in SWEEPS[name]] for name in sweeps}, "frames": grown}


def summarize(found: Mapping[str, Any]) -> str:
    """Formats the costs and their exponents as Markdown tables."""
    lines = []
    for name, costs in found["sweeps"].items():
        amounts = [amount(name, size) for size in SWEEPS[name]]
        lines += ["", f"| {name} | update, s | view, ms | frame 0, s | memory, MB |", "|---|---|---|---|---|"]
        lines += [
            f"| {size:,.10g} | {one['update']:.2f} | {1e3 * one['view']:.0f} | "
            f"{one['frame_0']:.2f} | {one['memory']:.0f} |"
            for size, one in zip(amounts, costs, strict=True)
        ]
        slopes = [slope(amounts, [one[field.name] for one in costs]) for field in fields(Cost)]
        lines.append("| **exponent** | " + " | ".join(f"**{each:.2f}**" for each in slopes) + " |")
    if found["frames"]:
        kept = list(found["frames"])
        titles = [f"memory with states in {name}, MB" for name in kept]
        lines += ["", f"| frames of one process | {' | '.join(titles)} |", "|---" * (1 + len(kept)) + "|"]
        for count in found["frames"][kept[0]]:
            lines.append(
                f"| {int(count):,} | " + " | ".join(f"{found['frames'][name][count]:.0f}" for name in kept) + " |"
            )
    return "\n".join(lines).strip()


def plot(found: Mapping[str, Any], path: Path) -> None:
    """Plots the seconds per update against each size, relative to the smallest size, on logarithmic axes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 5), layout="tight")
    for name, costs in found["sweeps"].items():
        amounts = [amount(name, size) for size in SWEEPS[name]]
        seconds = [one["update"] for one in costs]
        axes.loglog([each / amounts[0] for each in amounts], [each / seconds[0] for each in seconds], "o-", label=name)
    ends = axes.get_xlim()
    axes.loglog([1, ends[1]], [1, ends[1]], "k:", linewidth=1, label="proportional")
    axes.set(xlabel="size, relative to the smallest", ylabel="seconds per update, relative to the smallest")
    axes.legend()
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def _kept(work: Path, asked: Mapping[str, Any]) -> Any:
    """Returns the figures of a size or of several frame counts, measured in a new process unless they are stored."""
    name = "-".join(f"{key}_{value}" for key, value in asked.items()).replace(" ", "").replace("[", "").replace("]", "")
    ways = crc32(json.dumps([SCENE, ITERATIONS, FIRST_ITERATIONS, UPDATES]).encode())  # changes with the settings
    file = work / f"{name}-{ways:08x}.json"
    if not file.exists():
        done = subprocess.run(
            [sys.executable, "-m", "studies.scale.scale", json.dumps(asked)], capture_output=True, text=True, check=True
        )
        part = file.with_suffix(".part")
        part.write_text(done.stdout.splitlines()[-1])
        part.replace(file)
    return json.loads(file.read_text())


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print(json.dumps(growth(**given) if "frames" in given else asdict(cost(Size(**given)))))
