"""Runs that the targets need: captures, preset and changes of each. ``scripts/bench targets`` measures them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from client.cli.evaluate import Job, Report
from client.cli.scores import Row, Store
from scas4d_core.presets import preset
from scas4d_core.settings import Settings
from studies.quality.quality import OBJECT_CAPTURES, run_jobs
from studies.quality.settings import settings_of

CAPTURES = (*OBJECT_CAPTURES, "stage", "basketball")
"""Every capture of the targets, by the name of its folder."""

CAPTURE_CHANGES: Mapping[str, tuple[str, ...]] = {}
"""What a scene itself asks for in every run of it (its budget of Gaussians, its floor), never what tunes a method."""

OTHER_MAP = "published" if preset("scas4d").update.cluster_map == "centred" else "centred"
"""The cluster map that is not the default."""


@dataclass(frozen=True)
class Run:
    """One way to reconstruct some captures.

    Attributes:
        captures: names of folders. preset: name. iterations: of an update.
        changes: further settings, as ``"update.clusters=[64]"``.
        masks, points: whether the method gets them.
        frames: only so many frames; None: all.
    """

    captures: tuple[str, ...]
    preset: str = "scas4d"
    iterations: int = 100
    changes: tuple[str, ...] = ()
    masks: bool = True
    points: bool = True
    frames: int | None = None

    def settings(self, capture: str) -> Settings:
        """Returns the complete settings of the run for a capture."""
        return settings_of(self.preset, self.iterations, changes=[*CAPTURE_CHANGES.get(capture, ()), *self.changes])

    def job(self, folder: Path, frames: int | None = None) -> Job:
        """Returns the row of one capture, with at most a number of frames."""
        limits = [limit for limit in (frames, self.frames) if limit is not None]
        return Job(
            capture=folder,
            preset=self.preset,
            settings=self.settings(folder.resolve().name),
            frames=min(limits) if limits else None,
            masks=self.masks,
            points=self.points,
        )


RUNS: Mapping[str, Run] = {
    "scas4d": Run(CAPTURES),
    "robot-unaided": Run(("robot",), masks=False, points=False, frames=1),
    "basketball-cloudless": Run(("basketball",), points=False, frames=1),
    "dynamic3dgs": Run(CAPTURES, "dynamic3dgs"),
    "clusters-64": Run(OBJECT_CAPTURES, changes=("update.clusters=[64]",)),
    "clusters-320": Run(OBJECT_CAPTURES, changes=("update.clusters=[320]",)),
    "clusters-1280": Run(OBJECT_CAPTURES, changes=("update.clusters=[1280]",)),
    "other-map": Run(CAPTURES, changes=(f"update.cluster_map={OTHER_MAP}",)),
    "dynamic3dgs-2000": Run(OBJECT_CAPTURES, "dynamic3dgs", 2000),
}
"""By name, in the order in which they are measured: the costliest last."""


def measure_runs(
    captures: Path,
    out: Path,
    names: Sequence[str] = (),
    *,
    only: Sequence[str] = (),
    frames: int | None = None,
    again: bool = False,
    report: Report = print,
) -> list[Row]:
    """Measures runs on the available captures; existing rows are not measured again.

    Args:
        captures: folder of the captures' folders.
        out: folder of the study.
        names: of ``RUNS``; none: all.
        only: captures by name; none: all of each run.
        frames: only so many frames of each; None: all.
        again: measure rows anew that are on disk.
        report: takes the lines that are printed.

    Raises:
        ValueError: an unknown run or capture, or no capture of any run in the folder.
    """
    for name in names:
        if name not in RUNS:
            raise ValueError(f"run {name!r} is unknown; choose of {', '.join(RUNS)}")
    for name in only:
        if name not in CAPTURES:
            raise ValueError(f"capture {name!r} has no targets; choose of {', '.join(CAPTURES)}")
    jobs: list[Job] = []
    missing: dict[str, None] = {}
    for name in names or RUNS:
        for capture in RUNS[name].captures:
            if only and capture not in only:
                continue
            if (captures / capture).is_dir():
                jobs.append(RUNS[name].job(captures / capture, frames))
            else:
                missing[capture] = None
    for capture in missing:
        report(f"{captures / capture}: no such folder; left out")
    if not jobs:
        raise ValueError(f"{captures} holds none of the captures asked for; give the folder that holds their folders")
    return run_jobs(jobs, out, again=again, report=report)


FIRST_FRAME = "scas4d_core.first_frame."
"""The room of the constants that frame 0 depends on."""


def measured_runs(store: Store) -> dict[tuple[str, str], Row]:
    """Returns the stored rows with these settings by run and capture; if there are several, the longest.

    A row belongs to a run where its settings are, to the last number, those the run has today; where only frame 0 is
    asked for, those of updates do not count.
    """
    rows = [row for row in store.rows() if "error" not in row]
    by_run: dict[tuple[str, str], Row] = {}
    for name, run in RUNS.items():
        for capture in run.captures:
            settings = run.settings(capture).model_dump(mode="json")
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
