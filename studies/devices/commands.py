"""The command `scripts/bench devices`."""

from __future__ import annotations

from typing import Annotated

import typer

from studies.options import Captures, Page, show


def devices(
    captures: Captures,
    apart: Annotated[
        bool, typer.Option("--apart", help="Let each device continue from its own states, not from the CPU's.")
    ] = False,
    page: Page = None,
) -> None:
    """Compares images and tracks of updates on the CPU and on a GPU, from the same states.

    Without a GPU, the GPU kernels run on the CPU.

    Example: scripts/bench devices samples/robot
    """
    from studies.devices.devices import compare, table, use_cpu_without_gpu
    from studies.machine import in_words, machine

    stands_for = use_cpu_without_gpu()
    rows = [row for folder in captures for row in compare(folder, apart=apart)]
    text = f"{table(rows)}\n\n*GPU* is {stands_for}. {in_words(machine())}."
    show(text, page)
