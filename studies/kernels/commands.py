"""The commands `scripts/bench kernels` and `gpu-kernels`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import QUALITY, Changes, Page, write_page, write_part


def kernels(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder; the targets apply to robot.")],
    out: Page = None,
    store: Annotated[Path, typer.Option(help="Study folder, which `scripts/bench table` reads.")] = QUALITY,
    changes: Changes = None,
) -> None:
    """Compares rasterizer time with that of its arithmetic, and update time with rasterizer time, on the CPU.

    Also measures peak memory, for which frame 0 is fitted again. Requires an idle machine. NUMBA_NUM_THREADS sets the
    number of threads.
    """
    from studies.kernels import kernels as study
    from studies.quality.settings import settings_of

    settings = settings_of("scas4d", changes=changes or ())
    row = study.study(capture, settings, store)
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
