"""The command `scripts/bench gpu-check`."""

from __future__ import annotations

import json
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import typer

ROOT = Path(__file__).parents[2]


def gpu_check(
    captures: Annotated[
        list[Path] | None,
        typer.Argument(metavar="CAPTURE...", help="Captures to reconstruct in addition to the sample."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Output folder for gpu-check.json and gpu-check.md.")] = Path(
        "out/gpu-check"
    ),
    seconds: Annotated[
        float, typer.Option(min=10, help="Time limit in seconds; parts that have not started by then are skipped.")
    ] = 360,
    quick: Annotated[
        bool, typer.Option(help="Use small sizes and few frames, to try the check without a GPU.")
    ] = False,
) -> None:
    """Checks the GPU engine on this machine: tests, accuracy, times per kernel and frame, and spread over runs.

    Requires no network. Each part is written as soon as it is measured. Without a GPU, the kernels run on the CPU.
    """
    from studies.devices.devices import use_cpu_without_gpu
    from studies.gpu import check
    from studies.wall import Size

    stands_for, began = use_cpu_without_gpu(), perf_counter()
    sample, frames = ROOT / "samples" / "robot", 3 if quick else None
    changes: dict[str, Any] = {}
    if quick:
        changes = {"scene": {"image_scale": 0.25}, "static": {"iterations": 50}, "update": {"iterations": 10}}
    sizes = (Size(gaussians=900, width=64, height=64, cameras=6, moving=1.0),) if quick else check.SIZES
    found: dict[str, Any] = {
        "card": {"device": stands_for, **check.graphics_card()},
        "captures": [],
        "sizes": [],
        "views": [],
    }
    out.mkdir(parents=True, exist_ok=True)

    def write(part: str) -> bool:
        """Writes all measurements so far and returns whether there is time for the next part."""
        (out / "gpu-check.json").write_text(json.dumps(found, indent=1))
        (out / "gpu-check.md").write_text(check.page(found) + "\n")
        elapsed = perf_counter() - began
        typer.echo(f"{elapsed:6.1f} s  {part}")
        return elapsed < seconds

    for device in ("gpu", "cpu"):
        found["captures"].append(check.whole_capture(sample, device, frames, **changes))
        write(f"sample on the {device}")
    for size in sizes:
        for views in check.VIEWS:
            if write("sizes"):
                found["sizes"].append(check.one_size(size, views, 5 if quick else 100))
        if write(f"{size.gaussians} Gaussians"):
            found["views"].append(check.view_time(size))
    if write("sizes done"):
        found["spread"] = check.spread(sample, 2 if quick else 10, 3, **changes)
    for folder in captures or []:
        if write("spread done"):
            found["captures"].append(check.whole_capture(folder, "gpu", frames, **changes))
    if write("captures done") and not quick:
        found["tests"] = check.run_tests(ROOT, max(30.0, seconds - (perf_counter() - began)))
    write("done")
    typer.echo(check.page(found))
