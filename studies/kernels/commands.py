"""The commands `scripts/bench kernels`, `gpu-kernels`, `moving` and `startup`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import QUALITY, Capture, Changes, Page, write_page, write_part


def kernels(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder; the targets apply to robot.")],
    out: Page = None,
    store: Annotated[Path, typer.Option(help="Study folder, which `scripts/bench table` reads.")] = QUALITY,
    preset: Annotated[str, typer.Option(help="Settings preset.")] = "scas4d",
    frames: Annotated[
        int, typer.Option(min=3, help="Number of frames in the timed run; the first update is not counted.")
    ] = 8,
    repeats: Annotated[int, typer.Option(min=1, help="Repetitions of the rasterizer and its arithmetic.")] = 9,
    changes: Changes = None,
) -> None:
    """Compares rasterizer time with that of its arithmetic, and update time with rasterizer time, on the CPU.

    Also measures peak memory, for which frame 0 is fitted again. Requires an idle machine. NUMBA_NUM_THREADS sets the
    number of threads.
    """
    from studies.kernels import kernels as study
    from studies.quality.settings import settings_of

    settings = settings_of(preset, changes=changes or ())
    row = study.study(capture, settings, store, frames=frames, repeats=repeats)
    if out is not None:
        write_part(out, study.page(row))


def gpu_kernels(
    ptxas: Annotated[
        Path | None,
        typer.Option(help="ptxas of CUDA 13.4 or later, from the package nvidia-cuda-nvcc; default: on PATH."),
    ] = None,
    architectures: Annotated[
        list[int] | None,
        typer.Option("--arch", help="Compute capability times 10, such as 90. May be repeated; default: all."),
    ] = None,
    out: Page = None,
) -> None:
    """Compiles the GPU kernels without a GPU, and reports registers and spills per thread if ptxas is available."""
    from scas4d_core.engines.warp.compile_ahead import ARCHITECTURES
    from studies.kernels import gpu_kernels as study

    assembler = ptxas or study.find_ptxas()
    uses = study.measure(architectures or ARCHITECTURES, assembler)
    text = study.table(uses) if assembler else "All kernels compile. Register counts are unknown without ptxas."
    typer.echo(text)
    write_page(out, text)


def moving(
    share: Annotated[
        list[float] | None, typer.Option(min=0.01, max=1, help="Share of moving pixels; default 0.05, 0.2 and 1.")
    ] = None,
    frames: Annotated[int, typer.Option(min=2, help="Updates per share; the first one is not counted.")] = 8,
    out: Page = None,
) -> None:
    """Measures how the update time depends on the share of moving pixels, on synthetic footage."""
    from scas4d_core.warm_up import compile_in_processes
    from studies.kernels import moving as study

    compile_in_processes()
    text = study.table(study.measure(share or (0.05, 0.2, 1.0), frames))
    typer.echo(text)
    write_page(out, text)


def startup(
    capture: Capture,
    against: Annotated[Path | None, typer.Option(help="Another checkout to compare with; runs alternate.")] = None,
    repeats: Annotated[int, typer.Option(min=1, help="Number of starts per checkout.")] = 3,
    out: Page = None,
) -> None:
    """Times the start of a service, from an empty kernel cache to the first committed update."""
    from studies.kernels import startup as study

    checkouts = [study.ROOT] if against is None else [against.resolve(), study.ROOT]
    text = study.table(study.measure(capture, checkouts, repeats, typer.echo))
    typer.echo(text)
    write_page(out, text)
