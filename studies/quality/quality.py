"""Rows of scores: each capture's images, tracks and parts, and seconds per update.

Each row runs in a separate process, so that its peak memory can be measured. Rows already on disk are not run again.
Frame 0 is fitted only once for all rows of a capture with the same scene and frame 0 settings. It is stored in the
study folder under ``first/``. An interrupted row is restarted from frame 0.
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

from client.cli import evaluate
from client.cli.evaluate import Job, Report, score_tables
from client.cli.scores import QUALITY, Row, Store, digest
from scas4d_core.warm_up import compile_in_processes
from studies.apart import in_a_process
from studies.constants import all_varied
from studies.machine import core_version, machine

OBJECT_CAPTURES = ("robot", "wheel", "pendulums", "cloth", "spring")
"""Captures over which the table also contains the mean scores."""
LATER = ("scas4d_core.update.", "scas4d_core.robust.", "scas4d_core.structure.")
"""Prefixes of constants that do not affect frame 0. Rows share a frame 0 only if they agree in all other constants."""


def run_jobs(jobs: Sequence[Job], out: Path, *, again: bool = False, report: Report = print) -> list[Row]:
    """Measures the missing rows, each in its own process, and returns all rows in the order of the jobs.

    Prints the table and writes it to ``out/table.md``. A failed row has an ``error`` and is retried on the next call.
    With ``again``, also repeats the rows already on disk.
    """
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
            other = "" if row.get("core") == core_version() else ", with another version of the core"
            report(f"[{number}/{len(jobs)}] {job.key}: already measured{other}")
        rows.append(row)
    table = score_tables(with_means(rows), rows)
    (store.folder / "table.md").write_text(table + "\n")
    report(table)
    return rows


def measure(job: Job, folder: Path, report: Report = print) -> Row:
    """Measures one capture and returns its row. Reuses a frame 0 that another row of the study has already fitted.

    Raises:
        CaptureError: the capture cannot be read.
    """
    given = job.open_given()
    # These imports load the kernels, which the table and the command do not need.
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
    """Returns the rows, followed by the means of each variant that was measured on all captures in ``over``.

    Rows with the same ``variant`` value form a variant. The means cover the floating-point scores that all of its rows
    contain, except the worst PSNR and the peak memory.
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
    """Runs ``measure`` in a new process and returns the row. A failure is stored as the row's ``error``."""
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
        answer = {"error": "the process ended unexpectedly (out of memory, or killed)"}
    return failed | answer


def _measured_or_failed(job: Job, folder: Path) -> Row:
    try:
        return measure(job, folder, lambda line: print(line, flush=True))
    except Exception as error:
        traceback.print_exc()
        return {"error": f"{type(error).__name__}: {error}"}
