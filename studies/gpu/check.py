"""Measurements of the GPU check. Each function returns plain values for the JSON file and the page."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from client.cli.scores import Column, Row, markdown
from scas4d_core.captures import Capture, open_capture
from scas4d_core.engines.choose import WARP_DEVICE, warp_device
from scas4d_core.metrics.evaluation import measure_pictures
from scas4d_core.presets import preset
from scas4d_core.reconstruction import Reconstruction
from studies.wall import Size, known, rig, shown, wall

TESTS = (
    "tests/core/engines/warp", "tests/core/engines/test_contract.py", "tests/core/engines/test_renderers.py",
    "tests/core/fit/test_gaussian_fit.py",
)  # fmt: skip
SIZES = (
    Size(gaussians=22_000, width=256, height=256, cameras=16, moving=1.0),
    Size(gaussians=107_000, width=1280, height=720, cameras=16, moving=1.0),
    Size(gaussians=517_000, width=1920, height=1080, cameras=12, moving=1.0),
)
"""Scene sizes at which the prototype was measured: a small object, a stage, and a large stage."""
VIEWS = (1, 2, 4)
"""Numbers of views per iteration."""
SCENE = {"metres_per_unit": 1.0, "background": (0.0, 0.0, 0.0)}


def graphics_card() -> Row:
    """Returns the GPU's name, memory and architecture, and the versions of the driver and of Warp."""
    import warp

    device = warp.get_device(warp_device())
    facts: Row = {"name": device.name, "warp": warp.config.version}
    if device.is_cuda:
        facts |= {
            "memory_gb": round(device.total_memory / 1e9, 1),
            "architecture": device.arch,
            "driver": warp.get_cuda_driver_version(),
        }
    return facts


def run_tests(root: Path, seconds: float) -> Row:
    """Runs the engine's tests on the device and returns whether they passed, with the last line of their output.

    Args:
        root: folder of the checkout.
        seconds: time limit in seconds.
    """
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *TESTS]
    environment, began = {**os.environ, WARP_DEVICE: warp_device()}, perf_counter()
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:
        return {"passed": False, "last": f"stopped after {seconds:g} s", "seconds": seconds}
    lines = [line for line in done.stdout.splitlines() if line.strip()] or ["no output"]
    failed = [line for line in lines if line.startswith("FAILED")]
    return {"passed": done.returncode == 0, "last": lines[-1], "failed": failed, "seconds": perf_counter() - began}


def whole_capture(folder: Path, device: str, frames: int | None = None, **changes: Any) -> Row:
    """Reconstructs a capture with the default settings and returns times and PSNR on the test cameras.

    Args:
        folder: capture folder.
        device: "cpu" or "gpu".
        frames: number of frames; None for all.
        changes: further settings.
    """
    capture = open_capture(folder)
    scale = changes.get("scene", {}).get("image_scale", 1.0)
    settings = preset("scas4d", {"device": device, **changes})
    first = capture.frame(0)
    began = perf_counter()
    scene = Reconstruction.start(capture.rig, first, settings, points=capture.points)
    row: Row = {"capture": capture.name, "device": device, "frame_0": perf_counter() - began, "updates": []}
    row["gaussians"] = len(scene.history.gaussians(0))
    scored = open_capture(folder, image_scale=scale)
    row["psnr_0"] = measured(scene, scored, 0)
    psnr, stages = [], defaultdict[str, list[float]](list)
    for index in range(1, min(frames or capture.frame_count, capture.frame_count)):
        frame = capture.frame(index)
        began = perf_counter()
        report = scene.step(frame)
        row["updates"].append(perf_counter() - began)
        for stage, seconds in report.seconds.items():
            stages[stage].append(seconds)
        psnr.append(measured(scene, scored, index))
    row["stages"] = {stage: median(seconds) for stage, seconds in stages.items()}
    return row | {"update": median(row["updates"]), "psnr": float(np.mean(psnr)), "psnr_last": psnr[-1]}


def measured(scene: Reconstruction, capture: Capture, index: int) -> float:
    """Returns the mean PSNR of a frame on the test cameras in dB, or NaN without test cameras."""
    if capture.test_rig is None:
        return float("nan")
    value = measure_pictures(scene, capture, index)[0]["psnr"]
    return float("nan") if value is None else value


def one_size(size: Size, views: int, iterations: int = 100, updates: int = 4) -> Row:
    """Updates a scene of one size, and returns the median seconds of an update and the microseconds per kernel.

    The kernels are timed in a separate update.
    """
    state, cameras = wall(size), rig(size)
    changes = {"iterations": iterations, "views": views, "stop_gain": 0, "skip_tolerance": 0}
    settings = preset("scas4d", {"device": "gpu", "scene": SCENE, "update": changes})
    frames = [shown(state, index, cameras) for index in range(updates + 2)]
    scene = Reconstruction.start(cameras, frames[0], settings, static=known(state, cameras))
    seconds, stages = [], dict[str, float]()
    for frame in frames[1 : updates + 1]:
        began = perf_counter()
        report = scene.step(frame)
        seconds.append(perf_counter() - began)
        stages = dict(report.seconds)
    row: Row = {
        "gaussians": len(state), "width": size.width, "height": size.height, "views": views,
        "update": median(seconds[1:]), "stages": stages,
    }  # fmt: skip
    with kernel_times() as times:
        Reconstruction.start(cameras, frames[0], settings, static=known(state, cameras)).step(frames[1])
    return row | {"kernels": times}


@contextmanager
def kernel_times() -> Iterator[Row]:
    """Yields a dictionary that receives the launches and microseconds of each kernel used within the context."""
    import warp

    from scas4d_core.engines.warp.graphs import Graphs

    times: Row = {}
    Graphs.captures = False  # a graph is timed as a whole
    warp.timing_begin(cuda_filter=warp.TIMING_KERNEL | warp.TIMING_GRAPH)
    try:
        yield times
    finally:
        Graphs.captures = None
        total = defaultdict[str, list[float]](list)
        for result in warp.timing_end():
            total[result.name.split(" ")[-1]].append(1e3 * result.elapsed)
        for name, each in sorted(total.items(), key=lambda item: -sum(item[1])):
            times[name] = {"launches": len(each), "microseconds": median(each)}


def spread(folder: Path, runs: int, frames: int, **changes: Any) -> Row:
    """Repeats the same reconstruction, and returns the range of the PSNR and whether the states are bit-identical."""
    ends, digests = [], set()
    for _ in range(runs):
        capture = open_capture(folder)
        settings = preset("scas4d", {"device": "gpu", "static": {"iterations": 300}, **changes})
        scene = Reconstruction.start(capture.rig, capture.frame(0), settings, points=capture.points)
        for index in range(1, frames):
            scene.step(capture.frame(index))
        scale = changes.get("scene", {}).get("image_scale", 1.0)
        ends.append(measured(scene, open_capture(folder, image_scale=scale), frames - 1))
        digests.add(scene.history.gaussians(frames - 1).means.tobytes())
    return {"runs": runs, "psnr": ends, "range": max(ends) - min(ends), "same_bits": len(digests) == 1}


def view_time(size: Size, repeats: int = 20) -> Row:
    """Returns the median time to render a view in milliseconds, including the upload of the state."""
    from scas4d_core.engines.choose import renderer_of
    from scas4d_core.engines.limits import scene_limits
    from scas4d_core.engines.views import CameraArrays

    state, cameras = wall(size), rig(size)
    renderer = renderer_of("gpu", (0.0, 0.0, 0.0), scene_limits("auto", 3.0))
    camera = CameraArrays.of(cameras.cameras[0])
    times = []
    for _ in range(repeats):
        began = perf_counter()
        renderer.render(state, camera)
        times.append(1e3 * (perf_counter() - began))
    return {"gaussians": len(state), "width": size.width, "height": size.height, "view_ms": median(times[2:])}


def page(found: Row) -> str:
    """Formats all measurements as a Markdown page."""
    card = found["card"]
    lines = ["# GPU check", "", ", ".join(f"{name}: {value}" for name, value in card.items()), ""]
    if "tests" in found:
        lines += [f"Engine tests on the device: {found['tests']['last']}", *found["tests"].get("failed", []), ""]
    if found.get("captures"):
        lines += _captures(found["captures"])
    if found.get("sizes"):
        lines += _sizes(found["sizes"])
    if found.get("views"):
        views = [row | {"images": f"{row['width']}×{row['height']}"} for row in found["views"]]
        lines += [markdown(views, (*SIZE_COLUMNS, Column("view, ms", "view_ms", ".1f"))), ""]
    if "spread" in found:
        row = found["spread"]
        same = "bit-identical" if row["same_bits"] else "not bit-identical"
        lines.append(
            f"{row['runs']} identical runs: the PSNR of the last frame varies by {row['range']:.3f} dB; the states are "
            f"{same}."
        )
    return "\n".join(lines)


def _captures(rows: Sequence[Row]) -> list[str]:
    columns = (
        Column("capture", "capture"),
        Column("device", "device"),
        Column("Gaussians", "gaussians", ",d"),
        Column("frame 0, s", "frame_0"),
        Column("PSNR", "psnr_0"),
        Column("update, s", "update", ".3f"),
        Column("PSNR", "psnr"),
    )
    stages = [f"{row['capture']} on the {row['device']}: " + ", ".join(
        f"{stage} {1e3 * seconds:.1f}" for stage, seconds in row["stages"].items()
    ) for row in rows]  # fmt: skip
    return [markdown(rows, columns), "", "Median milliseconds by stage. " + ". ".join(stages) + ".", ""]


def _sizes(rows: Sequence[Row]) -> list[str]:
    for row in rows:
        row |= {"images": f"{row['width']}×{row['height']}"}
    update = Column("update of 100 iterations, s", "update", ".3f")
    sizes = markdown(rows, (*SIZE_COLUMNS, Column("views", "views", "d"), update))
    titles = [Column(f"{row['gaussians']:,}, {row['views']} views", str(k), ".0f") for k, row in enumerate(rows)]
    kernels: dict[str, Row] = {}
    for number, row in enumerate(rows):
        for name, times in row["kernels"].items():
            kernels.setdefault(name, {"name": f"`{name}`"})[str(number)] = times["microseconds"]
    return [sizes, "", markdown(kernels.values(), (Column("microseconds per launch", "name"), *titles)), ""]


SIZE_COLUMNS = (Column("Gaussians", "gaussians", ",d"), Column("images", "images"))
