"""``scripts/bench quality``: scores of pictures, tracks and parts of captures, and seconds per update.

One row for every capture, preset, number of iterations and seed. Each row runs in a process of its own, so that peak
memory is that row's; rows that are on disk already are not run again. Rows of a capture with the same settings of
scene and frame 0 share one frame 0 (``first/`` in the folder of the study); only the first of them fits it. A row that
was cut off begins again at its frame 0.
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from client.cli import evaluate
from client.cli.evaluate import DEFAULT_OPTIONS, Job, Report, score_tables
from client.cli.scores import QUALITY, Row, Store, digest
from client.importers.open_source import CaptureOptions
from scas4d_core.warm_up import compile_in_processes
from studies.apart import in_a_process
from studies.constants import all_varied
from studies.machine import core_version, machine
from studies.quality.settings import settings_of

OBJECT_CAPTURES = ("robot", "wheel", "pendulums", "cloth", "spring")
"""The captures whose mean is reported beside them."""
LATER = ("scas4d_core.update.", "scas4d_core.robust.", "scas4d_core.structure.")
"""What the names of constants begin with that frame 0 does not depend on: rows with others share no frame 0."""


def run(
    captures: Sequence[Path | str],
    out: Path | str,
    presets: Sequence[str] = ("scas4d",),
    *,
    iterations: Sequence[int] = (),
    seeds: Sequence[int] = (0,),
    changes: Sequence[str] = (),
    frames: int | None = None,
    masks: bool = True,
    points: bool = True,
    pictures: Sequence[int] = (0, 1, -1),
    lpips: bool = False,
    again: bool = False,
    options: CaptureOptions = DEFAULT_OPTIONS,
    report: Report = print,
) -> list[Row]:
    """Measures every capture with every preset; prints the table and writes it to ``out/table.md``.

    Args:
        captures: folders; those without test cameras are measured on their training cameras, and the rows say so.
        out: rows, per-frame lines and pictures go here; run again with the same folder to go on.
        presets: names.
        iterations: of an update, each tried; none: the preset's own.
        seeds: of frame 0 and of the updates, each tried.
        changes: further settings as ``"update.clusters=[64]"``, JSON behind the sign.
        frames: only so many frames of each capture; None: all.
        masks: False withholds the masks from the method.
        points: False withholds the initial cloud.
        pictures: frames to save as truth | render | difference; negative ones count from the end.
        lpips: also LPIPS where its weights are installed.
        again: measure rows anew that are on disk already.
        options: how the captures are read.
        report: takes the lines that are printed.

    Returns:
        The rows asked for, in order; a failed one has ``error`` and is tried again next time.

    Raises:
        ValueError: an unknown preset or setting, or a value out of range.
    """
    jobs = [
        Job(
            capture=Path(capture),
            preset=name,
            settings=settings_of(name, count, seed, changes),
            frames=frames,
            masks=masks,
            points=points,
            pictures=tuple(pictures),
            lpips=lpips,
            options=options,
        )
        for name in presets
        for count in (iterations or (None,))
        for seed in seeds
        for capture in captures
    ]
    return run_jobs(jobs, Path(out), again=again, report=report)


def run_jobs(jobs: Sequence[Job], out: Path, *, again: bool = False, report: Report = print) -> list[Row]:
    """Measures the missing rows, one process per row; prints the table and writes it to ``out/table.md``."""
    store = Store(out)
    if jobs:
        compile_in_processes()
    rows = []
    for number, job in enumerate(jobs, 1):
        row = None if again else store.row(job.key)
        if row is None:
            report(f"[{number}/{len(jobs)}] {job.key}")
            row = _apart(job, store.folder)
            store.put(row)
            if "error" in row:
                report(f"    failed: {row['error']}")
        else:
            other = "" if row.get("core") == core_version() else ", with other sources of the core"
            report(f"[{number}/{len(jobs)}] {job.key}: measured already{other}")
        rows.append(row)
    table = score_tables(with_means(rows), rows)
    (store.folder / "table.md").write_text(table + "\n")
    report(table)
    return rows


def measure(job: Job, folder: Path, report: Report = print) -> Row:
    """Measures one capture, from a frame 0 that other rows of the study may have fitted already.

    Raises:
        CaptureError: it cannot be read.
    """
    given = job.open_given()
    # These bring the kernels; the table and the command do not.
    from scas4d_core.kernels.jit import threads
    from studies.quality.first_frame import first_frame_key, load_first_frame, save_first_frame

    own = [one for one in job.constants if not one[0].startswith(LATER)]
    of = f"-{digest(own)}" if own else ""
    first_file = folder / "first" / f"{first_frame_key(given, job.settings)}{of}.npz"
    static = load_first_frame(first_file)
    if static is not None:
        report(f"    frame 0 from {first_file}")
    with all_varied(job.constants):
        _, row = evaluate.measure(
            job, Store(folder), report, static=static, fitted=lambda *found: save_first_frame(first_file, *found)
        )
    return row | {"core": core_version(), "machine": {**machine(), "threads": threads()}}


def with_means(rows: Sequence[Row], over: Sequence[str] = OBJECT_CAPTURES, label: str = "mean of objects") -> list[Row]:
    """Returns the rows, followed by the means of each variant that has all captures in ``over``.

    A variant is what has the same ``variant`` value; only numbers that every row of it has are averaged.
    """
    result = list(rows)
    for variant in dict.fromkeys(row["variant"] for row in rows if "error" not in row):
        of = {row["capture"]: row for row in rows if row["variant"] == variant and "error" not in row}
        if not all(name in of for name in over):
            continue
        chosen = [of[name] for name in over]
        mean: Row = {"capture": label, "preset": chosen[0]["preset"], "iterations": chosen[0]["iterations"]}
        mean["changes"] = chosen[0].get("changes")
        for column in QUALITY:
            values = [row.get(column.name) for row in chosen]
            if column.name in ("psnr_worst", "peak_mb"):
                continue
            if column.form.endswith("f") and all(isinstance(v, int | float) for v in values):
                mean[column.name] = sum(values) / len(values)  # type: ignore[arg-type]
        result.append(mean)
    return result


def _apart(job: Job, folder: Path) -> Row:
    """Runs ``measure`` in a new process; a failure is stored as the row's ``error``."""
    failed: Row = {
        "key": job.key,
        "variant": job.variant,
        "capture": job.capture.resolve().name,
        "preset": job.preset,
        "iterations": job.settings.update.iterations,
    }
    try:
        answer: Row = in_a_process(_measured_or_failed, job, folder)
    except BrokenProcessPool:
        answer = {"error": "its process ended before its time (out of memory, or killed)"}
    return failed | answer


def _measured_or_failed(job: Job, folder: Path) -> Row:
    try:
        return measure(job, folder, lambda line: print(line, flush=True))
    except Exception as error:
        traceback.print_exc()
        return {"error": f"{type(error).__name__}: {error}"}
