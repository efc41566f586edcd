"""All studies of `scripts/bench`. The modules of a study are imported only when it runs."""

from __future__ import annotations

import typer

from studies.compact.commands import compact
from studies.devices.commands import devices
from studies.exports.commands import exports
from studies.frontier.commands import frontier
from studies.gpu.commands import gpu_check
from studies.hard_frames.commands import alarms, timing
from studies.kernels.commands import kernels
from studies.live.commands import drawing, live, viewer
from studies.paper.commands import paper
from studies.quality.commands import (
    refit,
    table,
    targets,
)
from studies.rigs.commands import calibration, rigs
from studies.scale.commands import scale
from studies.service.commands import faults, memory, views
from studies.variants.commands import confidence, gaps, variants

STUDIES = {
    "Quality": (refit, targets, table, confidence),
    "Rigs": (rigs, calibration),
    "Quality of the output": (compact, exports),
    "Accuracy against time": (frontier, paper, variants, gaps),
    "Speed of the code": (kernels, scale, devices, gpu_check),
    "Faults of cameras": (timing, alarms),
    "The running service": (
        faults,
        live,
        viewer,
        drawing,
        views,
        memory,
    ),
}
"""Maps each heading of `scripts/bench --help` to its commands."""

app = typer.Typer(
    name="scripts/bench",
    no_args_is_help=True,
    add_completion=False,
    help="Studies that measure the method and the service, and generate the figures and pages in docs/.",
)
for heading, commands in STUDIES.items():
    for command in commands:
        app.command(rich_help_panel=heading)(command)
