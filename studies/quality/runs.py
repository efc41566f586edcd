"""The runs that the targets require, each with its captures, preset and changes; see ``scripts/bench targets``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from client.cli.evaluate import Job, Report
from client.cli.scores import Row, Store
from scas4d_core.settings import Settings
from studies.quality.quality import OBJECT_CAPTURES, run_jobs
from studies.quality.settings import settings_of

CAPTURES = (*OBJECT_CAPTURES, "stage", "basketball")
"""Folder names of the captures for which there are targets."""


@dataclass(frozen=True)
class Run:
    """Configuration with which certain captures are reconstructed.

    Attributes:
        captures: names of the capture folders.
        preset: preset name.
        masks: whether the masks are passed to the method.
        points: whether the initial points are passed to the method.
        frames: number of frames; all if None.
    """

    captures: tuple[str, ...]
    preset: str = "scas4d"
    masks: bool = True
    points: bool = True
    frames: int | None = None

    def settings(self) -> Settings:
        """Returns the complete settings of the run, with 100 iterations per update."""
        return settings_of(self.preset, 100)

    def job(self, folder: Path, frames: int | None = None) -> Job:
        """Returns the job that measures one capture, optionally limited to ``frames`` frames."""
        limits = [limit for limit in (frames, self.frames) if limit is not None]
        return Job(
            capture=folder,
            preset=self.preset,
            settings=self.settings(),
            frames=min(limits) if limits else None,
            masks=self.masks,
            points=self.points,
        )


RUNS: Mapping[str, Run] = {
    "scas4d": Run(CAPTURES),
    "robot-unaided": Run(("robot",), masks=False, points=False, frames=1),
    "basketball-cloudless": Run(("basketball",), points=False, frames=1),
    "dynamic3dgs": Run(CAPTURES, "dynamic3dgs"),
}
"""Runs by name, in the order in which they are measured."""


def measure_runs(
    captures: Path,
    out: Path,
    names: Sequence[str] = (),
    *,
    frames: int | None = None,
    again: bool = False,
    report: Report = print,
) -> list[Row]:
    """Measures runs on the available captures. Existing rows are not measured again.

    For the arguments, see ``scripts/bench targets --help``.

    Returns:
        One row per run and available capture.

    Raises:
        ValueError: a run is unknown, or the folder contains no capture of any run.
    """
    for name in names:
        if name not in RUNS:
            raise ValueError(f"unknown run {name!r}; choose from {', '.join(RUNS)}")
    jobs: list[Job] = []
    missing: dict[str, None] = {}
    for name in names or RUNS:
        for capture in RUNS[name].captures:
            if (captures / capture).is_dir():
                jobs.append(RUNS[name].job(captures / capture, frames))
            else:
                missing[capture] = None
    for capture in missing:
        report(f"{captures / capture}: no such folder; skipping it")
    if not jobs:
        raise ValueError(f"{captures} contains none of the requested captures; pass their parent folder")
    return run_jobs(jobs, out, again=again, report=report)


FIRST_FRAME = "scas4d_core.first_frame."
"""Prefix of the constants on which frame 0 depends."""


def measured_runs(store: Store) -> dict[tuple[str, str], Row]:
    """Returns the stored row of each run and capture; of several rows, the one with the most frames.

    A row belongs to a run if its settings equal the run's current settings exactly. If only frame 0 is needed, update
    settings are ignored. Combinations of run and capture without such a row are omitted.
    """
    rows = [row for row in store.rows() if "error" not in row]
    by_run: dict[tuple[str, str], Row] = {}
    for name, run in RUNS.items():
        for capture in run.captures:
            settings = run.settings().model_dump(mode="json")
            groups = ("scene", "static") if run.frames == 1 else tuple(settings)
            for row in rows:
                given = row["given"]
                withheld = (given["masks"], given["points"])
                same = all(row["settings"].get(group) == settings[group] for group in groups)
                varied = row["settings"].get("constants", ())
                same &= not any(run.frames != 1 or place.startswith(FIRST_FRAME) for place in varied)
                if row["capture"] != capture or not same or withheld != (run.masks, run.points):
                    continue
                best = by_run.get((name, capture))
                if best is None or given["frames"] > best["given"]["frames"]:
                    by_run[name, capture] = row
    return by_run
