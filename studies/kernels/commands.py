"""The command `scripts/bench kernels`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from studies.options import QUALITY, Changes, Page, write_part


def kernels(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="Capture folder; the targets apply to robot.")],
    out: Page = None,
    store: Annotated[Path, typer.Option(help="Study folder, which `scripts/bench table` reads.")] = QUALITY,
    changes: Changes = None,
) -> None:
    """Compares rasterizer time with that of its arithmetic, and update time with rasterizer time, on the CPU.

    Also measures peak memory, for which frame 0 is fitted again. Requires an idle machine. NUMBA_NUM_THREADS sets the
    number of threads.

    After writing docs/kernels.md with --out, record its figures: `scripts/figures.py page docs/kernels.md COMMAND`.
    """
    from studies.kernels import kernels as study
    from studies.quality.settings import settings_of

    settings = settings_of("scas4d", changes=changes or ())
    row = study.study(capture, settings, store)
    if out is not None:
        write_part(out, study.page(row))
