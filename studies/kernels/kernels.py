"""``scripts/bench kernels``: cost of the kernels, compared with the cost of their arithmetic.

1. The rasterizer, forward and backward, is compared with a micro-kernel that does only the arithmetic of the same
   number of blended pairs (``studies.kernels.pairs``). The two alternate in one process, on the same threads. The
   rasterizer renders all views of frame 0, and a cloud of wider Gaussians, in which pairs dominate the cost.
2. Updates are compared with their own rasterizer passes. The seconds of ``Reconstruction.step``, including decoding and
   committing, are divided by those of its stages "render" and "render backward".
3. The parallel regions that an iteration enters are counted, and updates with all threads are compared with updates
   with one thread, in alternation (``studies.kernels.regions``).
4. The peak memory of these updates, including the fit of frame 0, is measured in a fresh process.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from client.cli.evaluate import Report, peak_megabytes
from client.cli.scores import Row
from client.importers.open_source import open_source
from scas4d_core.cameras import Camera, rig_inside
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import DEFAULT, Limits, scene_limits
from scas4d_core.engines.views import CameraArrays
from scas4d_core.gaussians import Gaussians
from scas4d_core.kernels.jit import threads
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from scas4d_core.warm_up import compile_in_processes
from studies.apart import in_a_process
from studies.kernels import regions
from studies.kernels.pairs import MicroKernel, blended_pairs
from studies.machine import core_version, in_words, machine
from studies.marks import marked, marked_table
from studies.quality.first_frame import first_frame_key, load_first_frame, save_first_frame
from studies.quality.targets import KERNELS, TARGETS

FRAMES, REPEATS = 8, 9
"""Number of frames of the timed run, whose first update is not counted, and of runs of the rasterizer."""
PASSES = ("render", "render backward")
"""Stages of an update that belong to the rasterizer."""
CLOUD_GAUSSIANS, CLOUD_SIZE = 20_000, 256
"""Number of Gaussians in the cloud, and width and height of its image in pixels."""
CLOUD_WIDTH = 2.1
"""Standard deviation of the cloud's Gaussians in pixels.

With this width, there are about 145 pixels per Gaussian and 2.9 million pairs per image.
"""


def study(folder: Path, settings: Settings, store: Path, *, report: Report = print) -> Row:
    """Makes all measurements on a capture, prints them, writes them to ``store/kernels.json``, and returns them.

    Args:
        folder: capture folder.
        settings: settings of frame 0 and the updates.
        store: study folder.
        report: callback that prints progress messages.

    Raises:
        BrokenProcessPool: the process that runs the updates ended early.
    """
    capture = open_source(folder)
    first_file = store / "first" / f"{first_frame_key(capture, settings)}.npz"
    report(f"running {min(FRAMES, capture.frame_count)} frames, starting with frame 0, in a separate process")
    compile_in_processes()
    timed = in_a_process(run_and_time, folder, settings, FRAMES, first_file)
    report("counting parallel regions, and comparing one thread with all threads")
    entered = in_a_process(regions.count_regions, folder, settings, 3, first_file)
    by_threads = in_a_process(regions.compare_threads, folder, settings, FRAMES, first_file)
    kept = load_first_frame(first_file)
    assert kept is not None  # stored by the run
    world = capture.rig.world_frame(settings.scene.metres_per_unit)
    rig = rig_inside(world, capture.rig.scaled(settings.scene.image_scale).cameras)
    report(f"running the rasterizer and the micro-kernel {REPEATS} times, in alternation")
    limits = scene_limits(settings.scene.near, rig.radius)
    on_frame_0 = measure_rasterizer(kept[0].gaussians, rig.cameras, REPEATS, limits)
    cloud, camera = make_cloud()
    on_cloud = measure_rasterizer(cloud, [camera] * 4, REPEATS)
    row: Row = {
        "capture": capture.name,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "core": core_version(),
        "machine": {**machine(), "threads": threads()},
        "settings": settings.model_dump(mode="json"),
        "frame_0": on_frame_0,
        "cloud": on_cloud,
        "ratio_rasterizer": on_frame_0["ratio"]["median"],
        "ratio_rasterizer_cloud": on_cloud["ratio"]["median"],
        **update_figures(timed["updates"]),
        "regions": entered,
        "ratio_threads": spread(np.divide(by_threads["all"], by_threads["one"])[1:]),
        "iterations": settings.update.iterations,
        "frames": timed["frames"],
        "peak_mb": timed["peak_mb"],
    }
    store.mkdir(parents=True, exist_ok=True)
    (store / f"{KERNELS}.json").write_text(json.dumps(row, indent=1))
    report(table(row))
    return row


def measure_rasterizer(gaussians: Gaussians, cameras: Sequence[Camera], repeats: int, limits: Limits = DEFAULT) -> Row:
    """Returns the nanoseconds per pair of the rasterizer and of the micro-kernel, and their ratio.

    The rasterizer renders four channels: colour and foreground.

    Args:
        gaussians: Gaussians to render.
        cameras: cameras in internal world coordinates.
        repeats: number of measurements.
        limits: rasterizer limits of the scene.
    """
    rasterizer = CpuRasterizer(limits)
    features = np.concatenate([gaussians.colours, gaussians.foreground[:, None]], axis=1)
    background = np.zeros(4, np.float32)
    views = [CameraArrays.of(camera) for camera in cameras]
    pairs = lanes = 0

    def forward(view: CameraArrays) -> None:
        rasterizer.forward(gaussians.means, gaussians.factors, gaussians.opacities, features, view, background)

    for view in views:
        forward(view)
        blended = blended_pairs(rasterizer.splats, rasterizer.counts, view.width, view.height, limits)
        pairs, lanes = pairs + int(blended[0].sum()), lanes + blended[1]
    micro = MicroKernel(threads())
    # Other processes do not affect a single thread's CPU time, but several threads also wait for each other.
    clock = time.process_time if threads() == 1 else time.perf_counter
    rounds = max(1, round(pairs / micro.run(1)))
    seconds: dict[str, list[float]] = {"forward": [], "backward": [], "micro": []}
    for _ in range(repeats + 1):
        spent = dict.fromkeys(seconds, 0.0)
        for view in views:
            started = clock()
            forward(view)
            spent["forward"] += clock() - started
            g_image, g_alpha = rasterizer.gradient_buffers()
            g_image[:, : view.height, : view.width] = 1e-3
            g_alpha[: view.height, : view.width] = 1e-3
            started = clock()
            rasterizer.backward(g_image, g_alpha)
            spent["backward"] += clock() - started
        started = clock()
        done = micro.run(rounds)
        spent["micro"] = (clock() - started) * pairs / done
        for name, value in spent.items():
            seconds[name].append(value)
    nanoseconds = {name: 1e9 * np.array(values[1:]) / pairs for name, values in seconds.items()}  # the first warms up
    nanoseconds["rasterizer"] = nanoseconds["forward"] + nanoseconds["backward"]
    return {
        "gaussians": len(gaussians),
        "views": len(views),
        "picture": [views[0].width, views[0].height],
        "pairs_per_view": pairs / len(views),
        "lanes_filled": pairs / lanes,
        "repeats": repeats,
        "ns_per_pair": {name: spread(values) for name, values in nanoseconds.items()},
        "ratio": spread(nanoseconds["rasterizer"] / nanoseconds["micro"]),
        "ratio_places": spread(nanoseconds["rasterizer"] / nanoseconds["micro"] * pairs / lanes),
    }


def make_cloud(seed: int = 0) -> tuple[Gaussians, Camera]:
    """Creates a camera, and round Gaussians 3 to 5 m in front of it that cover its image evenly.

    The opacities are between 0.1 and 0.9.
    """
    rng = np.random.default_rng(seed)
    focal, middle = float(CLOUD_SIZE), CLOUD_SIZE / 2
    depth = rng.uniform(3, 5, CLOUD_GAUSSIANS)
    places = (rng.uniform(0, CLOUD_SIZE, (CLOUD_GAUSSIANS, 2)) - middle) * depth[:, None] / focal
    gaussians = Gaussians(
        means=np.column_stack([places, depth]).astype(np.float32),
        factors=(np.eye(3) * (CLOUD_WIDTH / focal * depth)[:, None, None]).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (CLOUD_GAUSSIANS, 1)),
        opacities=rng.uniform(0.1, 0.9, CLOUD_GAUSSIANS).astype(np.float32),
        colours=rng.uniform(0, 1, (CLOUD_GAUSSIANS, 3)).astype(np.float32),
        foreground=np.ones(CLOUD_GAUSSIANS, np.float32),
        ids=np.arange(CLOUD_GAUSSIANS, dtype=np.int64),
    )
    intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
    return gaussians, Camera("cloud", intrinsics, np.eye(4), CLOUD_SIZE, CLOUD_SIZE)


def update_figures(updates: Sequence[Row]) -> Row:
    """Returns the seconds of updates and of their rasterizer passes, and the ratio, without the first update.

    Args:
        updates: updates in order, each with the ``seconds`` of the whole step and of its ``stages``.
    """
    counted = updates[1:]
    passes = np.array([sum(update["stages"][name] for name in PASSES) for update in counted])
    whole = np.array([update["seconds"] for update in counted])
    names = dict.fromkeys(name for update in counted for name in update["stages"])
    return {
        "updates": len(counted),
        "seconds_update": spread(whole),
        "seconds_passes": spread(passes),
        "seconds_stages": {n: float(np.median([u["stages"].get(n, 0.0) for u in counted])) for n in names},
        "ratio_update": float(np.median(whole / passes)),
        "ratio_update_spread": spread(whole / passes),
    }


def spread(values: Any) -> dict[str, float]:
    """Returns the minimum and the median of the values."""
    return {"min": float(np.min(values)), "median": float(np.median(values))}


def table(row: Row) -> str:
    """Formats the measurements as one Markdown table."""
    targets = {target.metric: target for target in TARGETS if target.run == KERNELS}

    def line(what: str, of: dict[str, float], unit: str, metric: str | None = None, digits: int = 2) -> str:
        must, word = "", ""
        if metric is not None:
            threshold, sense = targets[metric].threshold, targets[metric].sense
            assert threshold is not None
            reached = of["median"] < threshold or (sense == "≤" and of["median"] == threshold)
            must, word = f"{sense} {threshold:g} {unit}", "reached" if reached else "**missed**"
        return f"| {what} | {of['median']:.{digits}f} | {unit} | {must} | {word} |"

    lines = []
    for name, on, metric in (
        ("frame 0", row["frame_0"], "ratio_rasterizer"),
        ("cloud", row["cloud"], "ratio_rasterizer_cloud"),
    ):
        ns = on["ns_per_pair"]
        lines += [
            line(f"rasterizer forward, {name}", ns["forward"], "ns per pair"),
            line(f"rasterizer backward, {name}", ns["backward"], "ns per pair"),
            line(f"rasterizer total, {name}", ns["rasterizer"], "ns per pair"),
            line("arithmetic only", ns["micro"], "ns per pair"),
            line(f"rasterizer-to-arithmetic ratio, {name}", on["ratio"], "×", metric),
            line("ratio, counting all lanes", on["ratio_places"], "×"),
        ]
    iterations = row["iterations"]
    lines += [
        line(f"update with {iterations} iterations", row["seconds_update"], "s", digits=3),
        line(f"{iterations} rasterizer passes", row["seconds_passes"], "s", digits=3),
        line("update-to-rasterizer ratio", row["ratio_update_spread"], "×", "ratio_update"),
        line(f"update, {row['machine']['threads']} threads over one", row["ratio_threads"], "×"),
        line("parallel regions per iteration", {"median": row["regions"]}, "", digits=1),
        line("peak memory", {"median": row["peak_mb"]}, "MB", "peak_mb", 0),
    ]
    return "\n".join(["| | median | unit | target | |", "|---|---|---|---|---|", *lines])


BEGIN, END = "<!-- scripts/bench kernels: begin -->", "<!-- scripts/bench kernels: end -->"


def page(row: Row) -> str:
    """Returns the generated part of docs/kernels.md: command, machine, date, tables and measured quantities.

    Its figures are marked for ``scripts/figures.py``.
    """
    stages = sorted(row["seconds_stages"].items(), key=lambda item: -item[1])
    names = "|".join(f" {name} " for name, _ in stages)
    seconds = "|".join(f" {value:.3f} " for _, value in stages)
    by_stage = f"|{names}|\n|{'---|' * len(stages)}\n|{seconds}|"
    return f"""{BEGIN}

Measured with `scripts/bench kernels CAPTURES/{row["capture"]} --out docs/kernels.md` on
{marked(row["measured"][:10], "kernels-cost.date")}
(`{in_words(row["machine"])}`; source version of the core: {row["core"]}):

{marked_table(table(row), "kernels-cost")}

- A pair is one Gaussian blended into one pixel.
- Frame 0: {_scene_words(row["frame_0"], "frame_0")}.
- Cloud: {_scene_words(row["cloud"], "cloud")}.
- Rasterizer times cover projection, depth sorting, tile lists, blending, and their backward passes. "Arithmetic only"
  covers the exp and multiply-add operations for the same number of pairs, in cache, with four channels.
- "Counting all lanes" treats every pixel of the visited 4×4 blocks as a pair.
- Times are CPU time with one thread and wall-clock time with more. Ratios are medians of alternating runs.
- An update is one call of `Reconstruction.step`; its time is the median of {row["updates"]} updates. Peak memory is
  that of a process that fits frame 0 and runs {row["frames"] - 1} updates.

Median seconds per update, by stage:

{marked_table(by_stage, "kernels-stages")}

{END}"""


def _scene_words(on: Row, name: str) -> str:
    width, height = on["picture"]
    gaussians = marked(f"{on['gaussians']:,}", f"kernels-cost.{name}_gaussians")
    pairs = marked(f"{on['pairs_per_view']:,.0f}", f"kernels-cost.{name}_pairs")
    filled = marked(f"{100 * on['lanes_filled']:.0f}", f"kernels-cost.{name}_filled")
    return (
        f"{gaussians} Gaussians, {on['views']} images of {width}×{height}\n"
        f"  with an average of {pairs} pairs;\n"
        f"  {filled}% of the lanes are pairs"
    )


def run_and_time(folder: Path, settings: Settings, frames: int, first_file: Path) -> Row:
    """Reconstructs the first frames of a capture, and returns the seconds of each update and the peak memory in MB.

    Args:
        folder: capture folder.
        settings: settings of frame 0 and the updates.
        frames: number of frames, including frame 0.
        first_file: file in which frame 0 is stored.
    """
    capture = open_source(folder)
    count = min(frames, capture.frame_count)
    updates: list[Row] = []
    with Progress(console=Console(stderr=True), transient=True) as bars:
        bar = bars.add_task("frame 0")

        def moved(now: Any) -> None:
            bars.update(bar, description=f"frame 0, {now.stage}", completed=now.done, total=now.total)

        started = time.perf_counter()
        reconstruction = Reconstruction.start(
            capture.rig, capture.frame(0), settings, points=capture.points, progress=moved
        )
        assert reconstruction.static is not None
        save_first_frame(first_file, reconstruction.static, time.perf_counter() - started)
        bars.update(bar, description="updates", completed=0, total=count - 1)
        for index in range(1, count):
            frame = capture.frame(index)
            started = time.perf_counter()
            done = reconstruction.step(frame)
            updates.append({"seconds": time.perf_counter() - started, "stages": dict(done.seconds)})
            bars.advance(bar)
    return {"updates": updates, "frames": count, "peak_mb": peak_megabytes()}
