"""All studies of `scripts/bench`. The modules of a study are imported only when it runs."""

from __future__ import annotations

import typer

from studies.cluster.commands import cluster, head
from studies.compact.commands import compact, opening
from studies.devices.commands import devices
from studies.exports.commands import exports
from studies.frontier.commands import frontier
from studies.gpu.commands import gpu_check
from studies.hard_cases.commands import alarms, stability, timing
from studies.kernels.commands import gpu_kernels, kernels, moving, startup
from studies.live.commands import drawing, live, soak, viewer
from studies.paper.commands import paper
from studies.quality.commands import (
    effects,
    quality,
    refit,
    switches,
    table,
    targets,
)
from studies.rigs.commands import calibration, drift, rigs
from studies.scale.commands import scale
from studies.service.commands import faults, ingest, memory, sleeping, views
from studies.simulation.commands import simulate
from studies.variants.commands import confidence, gaps, variants

STUDIES = {
    "Quality": (quality, refit, effects, switches, targets, table, confidence),
    "Rigs": (rigs, calibration, drift),
    "Quality of the output": (compact, opening, exports),
    "Accuracy against time": (frontier, paper, variants, gaps),
    "Speed of the code": (kernels, gpu_kernels, moving, scale, startup, devices, gpu_check),
    "Hard cases": (stability, timing, alarms),
    "The running service": (
        faults,
        ingest,
        live,
        soak,
        viewer,
        drawing,
        views,
        memory,
        sleeping,
        cluster,
        head,
        simulate,
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
