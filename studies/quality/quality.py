"""``scripts/bench quality``: how good the pictures, tracks and parts of captures are, and how long an update takes.

One row for every capture, preset, number of iterations and seed. Each row runs in a process of its own, so that peak
memory is that row's; rows that are on disk already are not run again. Rows of a capture with the same settings of
scene and frame 0 share one frame 0 (``first/`` in the folder of the study); only the first of them fits it. A row that
was cut off begins again at its frame 0.
"""

from __future__ import annotations

import multiprocessing
import time
import traceback
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from scas4d_core.captures import open_capture
from scas4d_core.warm_up import warm_up_elsewhere
from studies.constants import all_varied
from studies.machine import core_version, machine
from studies.quality import measure as measures
from studies.quality.job import Job, settings_of
from studies.quality.store import Row, Store
from studies.quality.table import markdown, stage_table, with_means

Report = Callable[[str], None]


def run(
    captures: Sequence[Path | str],
    out: Path | str,
    presets: Sequence[str] = ("scas4d",),
    *,
    iterations: Sequence[int] = (),
    seeds: Sequence[int] = (0,),
    overrides: Sequence[str] = (),
    device: str | None = None,
    frames: int | None = None,
    masks: bool = True,
    points: bool = True,
    pictures: Sequence[int] = (0, 1, -1),
    lpips: bool = False,
    again: bool = False,
    report: Report = print,
) -> list[Row]:
    """Measures every capture under every preset; prints the table and leaves it in ``out/table.md``.

    Args:
        captures: folders with test cameras.
        out: rows, per-frame lines and pictures go here; run again with the same folder to go on.
        presets: names.
        iterations: of an update, each tried; none: the preset's own.
        seeds: of frame 0 and of the updates, each tried.
        overrides: further settings as ``"update.clusters=[64]"``, JSON behind the sign.
        device: "cpu" or "cuda"; None: the preset's.
        frames: only so many frames of each capture; None: all.
        masks: False withholds the masks from the method.
        points: False withholds the initial cloud.
        pictures: frames to save as truth | render | difference; negative ones count from the end.
        lpips: also LPIPS where its weights are installed.
        again: measure rows anew that are on disk already.
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
            settings=settings_of(name, count, seed, overrides, device),
            frames=frames,
            masks=masks,
            points=points,
            pictures=tuple(pictures),
            lpips=lpips,
        )
        for name in presets
        for count in (iterations or (None,))
        for seed in seeds
        for capture in captures
    ]
    return run_jobs(jobs, Path(out), again=again, report=report)


def run_jobs(jobs: Sequence[Job], out: Path, *, again: bool = False, report: Report = print) -> list[Row]:
    """Measures what is not on disk yet, one process a row; prints the table and leaves it in ``out/table.md``."""
    store = Store(out)
    if any(job.settings.device == "cpu" for job in jobs):
        warm_up_elsewhere()
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
    table = markdown(with_means(rows))
    if stages := stage_table(rows):
        table += f"\n\nMedian seconds of an update by stage:\n\n{stages}"
    (store.folder / "table.md").write_text(table + "\n")
    report(table)
    return rows


def measure(job: Job, folder: Path, report: Report = print) -> Row:
    """Reconstructs a job's capture with its settings and constants, see ``_measure``."""
    with all_varied(job.constants):
        return _measure(job, folder, report)


def _measure(job: Job, folder: Path, report: Report) -> Row:
    """Reconstructs one capture and measures everything that it can be measured by.

    Seconds are those of ``step`` alone. Peak memory is this process's, measuring included.
    """
    truth = open_capture(job.capture, image_scale=job.settings.scene.image_scale)
    given = open_capture(job.capture, use_masks=job.masks, use_points=job.points)
    if truth.test_rig is None:
        raise ValueError(f"{job.capture} has no test cameras (test_meta.json), so there is nothing to measure on")
    # These bring the kernels; the table and the command do not.
    from scas4d_core.kernels.jit import threads
    from scas4d_core.reconstruction import Reconstruction
    from studies.quality.first_frame import first_frame_key, load_first_frame, save_first_frame

    store = Store(folder)
    store.start_frames(job.key)
    count = given.frame_count if job.frames is None else min(job.frames, given.frame_count)

    lines: list[Row] = []
    with Progress(console=Console(stderr=True), transient=True) as bars:
        bar = bars.add_task("frame 0")

        def moved(now: Any) -> None:
            bars.update(bar, description=f"frame 0, {now.stage}", completed=now.done, total=now.total)

        first_file = folder / "first" / f"{first_frame_key(given, job.settings)}.npz"
        static, seconds_first = load_first_frame(first_file) or (None, 0.0)
        if static is not None:
            report(f"    frame 0 from {first_file}")
        started = time.perf_counter()
        reconstruction = Reconstruction.start(
            given.rig, given.frame(0), job.settings, points=given.points, progress=moved, static=static
        )
        if static is None:
            seconds_first = time.perf_counter() - started
            assert reconstruction.static is not None
            save_first_frame(first_file, reconstruction.static, seconds_first)
        bars.update(bar, description="frames", completed=0, total=count)
        for index in range(count):
            line: Row = {"index": index, "seconds": seconds_first, "stages": {}}
            if index:
                started, cpu = time.perf_counter(), time.process_time()
                done = reconstruction.step(given.frame(index))
                line["seconds"], line["cpu_seconds"] = time.perf_counter() - started, time.process_time() - cpu
                line["stages"] = {name: float(value) for name, value in done.seconds.items()}
                line["moving"], line["gaussians"] = int(done.moving), int(done.gaussians)
            scores, by_camera = measures.measure_pictures(reconstruction, truth, index, with_lpips=job.lpips)
            line |= scores
            store.put_frame(job.key, {**line, "cameras": by_camera})
            lines.append(line)
            bars.advance(bar)
            report(f"    frame {index:3d}/{count - 1}  {line['psnr']:6.2f} dB  {line['seconds']:6.2f} s")

    indices = list(range(count))
    row: Row = {
        "key": job.key,
        "variant": job.variant,
        "capture": truth.name,
        "preset": job.preset,
        "iterations": job.settings.update.iterations,
        "seed": job.settings.update.seed,
        "changes": job.changes,
        "settings": job.record,
        "given": {"frames": count, "masks": job.masks, "points": job.points},
        "capture_frames": given.frame_count,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "core": core_version(),
        "machine": {**machine(), "threads": threads()},
        "gaussians": len(reconstruction.history.gaussians(0)),
        "moving": int(reconstruction.history.gaussians(count - 1).moving.sum()),
        "seconds_first": seconds_first,
        "psnr_first": lines[0]["psnr"],
        **summary(lines),
    }
    if truth.ground_truth is not None and count > 1:
        row |= measures.measure_tracks(reconstruction, truth, indices)
        row |= measures.measure_parts(reconstruction, truth, indices)
    if count > 1:
        row |= measures.measure_flicker(reconstruction, truth, indices)
    row["peak_mb"] = peak_megabytes()
    pictures = folder / "pictures" / job.key
    for index in sorted({range(count)[i] for i in job.pictures if -count <= i < count}):
        measures.save_comparison(reconstruction, truth, index, pictures)
    if "parts_count" in row:
        labels = reconstruction.parts(int(row["parts_count"]))
        measures.save_parts(reconstruction, truth, indices[-1], labels, pictures)
    return row


def summary(lines: Sequence[Row]) -> Row:
    """What a table says of the per-frame lines: means over all updates (every frame but the first)."""
    updates = lines[1:]
    if not updates:
        return {"updates": 0}
    names = ("psnr", "psnr_foreground", "psnr_changed", "ssim", "flip", "lpips")
    stages = {name: float(np.median([line["stages"].get(name, 0.0) for line in updates])) for name in _stages(updates)}
    return {
        "updates": len(updates),
        **measures.mean_scores({name: line.get(name) for name in names} for line in updates),
        "psnr_worst": min(line["psnr"] for line in updates),
        "psnr_last": updates[-1]["psnr"],
        "psnr_by_frame": [round(line["psnr"], 3) for line in lines],
        # The first update compiles or loads kernels; medians do not see it.
        "seconds_update": float(np.median([line["seconds"] for line in updates])),
        "cpu_seconds_update": float(np.median([line["cpu_seconds"] for line in updates])),
        "seconds_stages": stages,
    }


def _stages(lines: Sequence[Row]) -> list[str]:
    """Names of the stages of an update, in the order in which they came."""
    return list(dict.fromkeys(name for line in lines for name in line["stages"]))


def peak_megabytes() -> float | None:
    """Largest resident memory of this process so far, 10⁶ bytes; None where the system does not tell (Windows)."""
    status = Path("/proc/self/status")
    if status.exists():  # what `getrusage` tells on Linux is, in a child, at least what its parent had
        peak = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(peak.split()[1]) * 1024 / 1e6
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _apart(job: Job, folder: Path) -> Row:
    """Runs ``measure`` in a fresh process; what goes wrong there becomes the row's ``error``."""
    failed: Row = {
        "key": job.key,
        "variant": job.variant,
        "capture": job.capture.resolve().name,
        "preset": job.preset,
        "iterations": job.settings.update.iterations,
    }
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(sender, job, folder))
    process.start()
    sender.close()
    try:
        answer: Any = receiver.recv()
    except EOFError:
        process.join()
        return failed | {"error": f"its process ended with exit code {process.exitcode} (out of memory, or killed)"}
    process.join()
    return failed | {"error": answer} if isinstance(answer, str) else dict(answer)


def _child(sender: Any, job: Job, folder: Path) -> None:
    try:
        answer: Any = measure(job, folder, lambda line: print(line, flush=True))
    except Exception as error:
        traceback.print_exc()
        answer = f"{type(error).__name__}: {error}"
    sender.send(answer)
    sender.close()
