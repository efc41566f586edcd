"""``scripts/bench frontier``: accuracy against time for many settings.

The study varies the iterations of each method, and one axis at a time around the default, ``scas4d`` with 100
iterations. Each row contains the results of one capture, one setting and one seed. All rows of a capture cover the same
first updates, so they are comparable. Rows are measured as in ``studies.quality``, and rows already on disk are not
measured again. Frame 0 is fitted once per capture and Gaussian budget. The reported seconds come from
``studies.frontier.timing``, which measures settings alternately, so rows may be measured on a busy machine.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from client.cli.evaluate import Job, Report, settings_record
from client.cli.scores import Row, Store
from scas4d_core.presets import PRESETS
from scas4d_core.settings import Settings
from studies.quality.quality import run_jobs
from studies.quality.settings import settings_of

METHODS = ("scas4d", "dynamic3dgs")
ITERATIONS = (10, 25, 50, 100, 200, 300, 500, 1000, 2000)
DEFAULT_ITERATIONS = 100
UPDATES = 5
"""Updates per row."""
MAX_SCALE = "scas4d_core.engines.plan.MAX_SCALE"
"""Constant that the axis "max-scale" varies."""


@dataclass(frozen=True)
class Variant:
    """One setting of the study.

    Attributes:
        label: short description for plots and tables.
        preset: preset name.
        iterations: iterations per update.
        changes: further settings, such as ``"update.clusters=[64]"``.
        constants: overridden constants of the method, as pairs of dotted name and value (``studies.constants``).
    """

    label: str
    preset: str = "scas4d"
    iterations: int = DEFAULT_ITERATIONS
    changes: tuple[str, ...] = ()
    constants: tuple[tuple[str, Any], ...] = ()

    @property
    def settings(self) -> Settings:
        """The complete settings."""
        return settings_of(self.preset, self.iterations, changes=self.changes)

    def job(self, capture: Path, updates: int) -> Job:
        """Returns the job that measures the first ``updates`` updates of a capture with this setting."""
        return Job(capture, self.preset, self.settings, updates + 1, pictures=(-1,), constants=self.constants)

    @property
    def record(self) -> Row:
        """The settings and constants as stored in a row."""
        return settings_record(self.settings, self.constants)


def _changed(label: str, name: str, value: object, *more: str) -> Variant:
    return Variant(label, changes=(f"{name}={json.dumps(value)}", *more))


DEFAULT = Variant("scas4d 100")
"""Default setting, around which the other axes vary and to which times are relative."""

AXES: Mapping[str, tuple[Variant, ...]] = {
    "iterations": tuple(Variant(f"{name} {count}", name, count) for count in ITERATIONS for name in METHODS),
    "adaptive": tuple(
        Variant(f"{name} {PRESETS[name].update.iterations}", name, PRESETS[name].update.iterations)
        for name in PRESETS
        if name not in METHODS and not PRESETS[name].effects  # docs/effects.md lists presets per kind of scene
    ),
    "layers": (
        _changed("K=1: 64", "update.clusters", [64]),
        _changed("K=1: 320", "update.clusters", [320]),
        _changed("K=1: 1280", "update.clusters", [1280]),
        _changed("K=2", "update.clusters", [64, 1280]),
        _changed("K=4", "update.clusters", [64, 175, 475, 1280]),
        _changed("K=5", "update.clusters", [64, 135, 285, 605, 1280]),
    ),
    "clusters": tuple(_changed(f"N={count}", "update.clusters", [count, 320, 1280]) for count in (16, 32, 48)),
    "views": (
        _changed("2 views", "update.views", 2),
        _changed("4 views", "update.views", 4),
        *(
            Variant(f"{count} iterations of {views} views", iterations=count, changes=(f"update.views={views}",))
            for views, count in ((2, 50), (4, 50), (4, 25))
        ),
    ),
    "max-scale": (Variant("max_scale 2 m", constants=((MAX_SCALE, 2.0),)),),
    "covariance": (_changed("separate covariance", "update.covariance", "separate", "update.deltas_start=0"),),
}
"""Axes of the study. Each axis varies one aspect of the default.

Additional layers are evenly spaced in log scale. A separate covariance consists of ΔR and Δs alone, so the deltas of
each Gaussian start immediately, with the first layer.
"""


def variants(axes: Sequence[str] = ()) -> list[Variant]:
    """Returns the default, followed by the other distinct settings of the given axes; all axes if empty.

    Raises:
        ValueError: an axis is unknown.
    """
    for name in axes:
        if name not in AXES:
            raise ValueError(f"unknown axis {name!r}; choose from {', '.join(AXES)}")
    return list(dict.fromkeys([DEFAULT, *(variant for name in axes or AXES for variant in AXES[name])]))


def measure_variants(
    captures: Sequence[Path], chosen: Sequence[Variant], out: Path, *, updates: int = UPDATES, report: Report = print
) -> list[Row]:
    """Measures the missing rows of settings on captures, cheapest first.

    Args:
        captures: folders of captures with test cameras.
        chosen: settings to measure.
        out: study folder.
        updates: updates per row.
        report: callback that prints progress messages.

    Returns:
        The rows measured by this call; failed rows have an ``error`` and are retried on the next call.
    """
    known = list(Store(out).rows())
    wanted = [(variant, capture) for variant in chosen for capture in captures]
    jobs = [
        variant.job(capture, updates)
        for variant, capture in sorted(wanted, key=lambda pair: pair[0].iterations)
        if row_of(known, variant, capture.resolve().name, updates) is None
    ]
    report(f"{len(wanted)} rows, {len(wanted) - len(jobs)} of them already measured")
    return run_jobs(jobs, out, report=report) if jobs else []


def row_of(rows: Iterable[Row], variant: Variant, capture: str, updates: int) -> Row | None:
    """Returns the row of a setting on a capture, or None if it was not measured.

    A row belongs to a setting if its stored settings equal the current ones exactly, and if it covers exactly the given
    number of updates, or the whole capture if it is shorter.
    """
    settings = variant.record
    for row in rows:
        if "error" in row or row["capture"] != capture or row["preset"] != variant.preset:
            continue
        given = row["given"]
        frames = min(updates + 1, row["capture_frames"])
        if given == {"frames": frames, "masks": True, "points": True} and row["settings"] == settings:
            return row
    return None
