"""`scas4d evaluate`: a capture reconstructed and scored on its test cameras and ground truth."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from client import pictures
from client.cli.changes import format_changes
from client.cli.reconstruct import compile_kernels, reconstruct_frames
from client.cli.scores import Row, Store, digest, markdown, stage_table
from client.importers.open_source import CaptureOptions
from client.progress import Bars
from scas4d_core.captures import Capture
from scas4d_core.presets import preset
from scas4d_core.settings import Settings

if TYPE_CHECKING:
    from scas4d_core.first_frame.static_result import StaticResult
    from scas4d_core.metrics.evaluation import Committed
    from scas4d_core.reconstruction import Reconstruction

Report = Callable[[str], None]
"""Takes each line that is printed."""


DEFAULT_OPTIONS = CaptureOptions()

TRAINING = "training cameras"
"""Mark of a row that scores training pictures, because there are no test cameras."""


@dataclass(frozen=True)
class Job:
    """One row to be measured.

    Attributes:
        capture: folder.
        preset: name, for the table.
        settings: of the reconstruction, complete.
        frames: only so many frames of the capture; None: all.
        masks: whether the method gets the masks (they are always used to measure).
        points: whether the method gets the initial cloud.
        pictures: frames whose comparison pictures are saved; negative ones count from the end.
        lpips: also LPIPS; loads torch.
        constants: of the method, by dotted name, to which a study gives another value; recorded with the row.
        options: how the capture is read.
    """

    capture: Path
    preset: str
    settings: Settings
    frames: int | None = None
    masks: bool = True
    points: bool = True
    pictures: tuple[int, ...] = (0, 1, -1)
    lpips: bool = False
    constants: tuple[tuple[str, Any], ...] = ()
    options: CaptureOptions = DEFAULT_OPTIONS

    def open_given(self) -> Capture:
        """The capture as the method gets it: at full size, without what is withheld."""
        use_masks = self.masks and self.options.use_masks
        return self.options.open(self.capture, use_masks=use_masks, use_points=self.points)

    def open_truth(self) -> Capture:
        """The capture as it is measured: scaled as rendered, and with test cameras, if they are those it trains on."""
        truth = self.options.open(self.capture, image_scale=self.settings.scene.image_scale)
        return truth if truth.full_test_rig is not None else truth.with_training_as_test()

    @property
    def record(self) -> Row:
        """The settings and constants as the row has them."""
        return settings_record(self.settings, self.constants)

    @property
    def variant(self) -> str:
        """Names the row without its capture: preset, iterations and a digest of everything else that is set."""
        update = self.settings.update
        given: Row = {"frames": self.frames, "masks": self.masks, "points": self.points}
        if self.lpips:
            given["lpips"] = True
        given |= self.options.changed
        return f"{self.preset}-{update.iterations}-s{update.seed}-{digest(self.record, given)}"

    @property
    def changes(self) -> str:
        """Differences from the preset beside iterations and seed, and what is withheld, in words for the table."""
        usual = preset(self.preset).model_dump(mode="json")
        words = [
            f"{name}={json.dumps(value, separators=(',', ':'))}"
            for name, value in format_changes(self.record, usual).items()
            if name not in ("update.iterations", "update.seed", "static.seed")
            and (name, value) != ("static.seconds", None)  # studies have no limit, and depend on no machine
        ]
        words += ["no masks"] * (not self.masks) + ["no points"] * (not self.points)
        words += [f"held out {', '.join(self.options.test)}"] if self.options.test else []
        words += [f"{name}={value}" for name, value in self.options.changed.items() if name != "test"]
        return ", ".join(words)

    @property
    def key(self) -> str:
        """Names the row; another setting is another row."""
        return f"{self.capture.resolve().name}-{self.variant}"


def settings_record(settings: Settings, constants: Sequence[tuple[str, Any]]) -> Row:
    """Settings as JSON, with those constants of the method that have another value, where there are any."""
    return settings.model_dump(mode="json") | ({"constants": dict(constants)} if constants else {})


def evaluate(
    folder: Path,
    out: Path,
    *,
    options: CaptureOptions = DEFAULT_OPTIONS,
    frames: int | None = None,
    preset_name: str = "scas4d",
    changes: Mapping[str, Any],
    again: bool = False,
    report: Report = print,
) -> Row:
    """Scores of a capture, printed as a table; `out` gets the row, a line a frame, pictures and table.md.

    Args:
        folder: of the capture; without test cameras its training cameras are measured, and the row says so.
        out: folder; scores that it holds are printed without another reconstruction.
        options: how the capture is read.
        frames: only so many; all where None.
        preset_name: named settings.
        changes: what differs from the preset, nested.
        again: measures anew what `out` holds.
        report: takes the printed lines.

    Raises:
        CaptureError: the capture cannot be read.
    """
    job = Job(folder, preset_name, preset(preset_name, changes), frames, options=options)
    for remark in options.open(folder).remarks:
        report(remark)
    store = Store(out)
    row = None if again else store.row(job.key)
    if row is None:
        report(f"[1/1] {job.key}")
        compile_kernels()
        _, row = measure(job, store, report)
        store.put(row)
    else:
        report(f"[1/1] {job.key}: measured already")
    table = score_tables([row])
    (out / "table.md").write_text(table + "\n")
    report(table)
    return row


def score_tables(rows: Sequence[Row], stages_of: Sequence[Row] | None = None) -> str:
    """The table of scores, and the table of seconds by stage where there were updates; Markdown."""
    table = markdown(rows)
    if stages := stage_table(rows if stages_of is None else stages_of):
        table += f"\n\nMedian seconds of an update by stage:\n\n{stages}"
    return table


def measure(
    job: Job,
    store: Store,
    report: Report,
    *,
    static: tuple[StaticResult, float] | None = None,
    fitted: Callable[[StaticResult, float], None] | None = None,
) -> tuple[Reconstruction, Row]:
    """Reconstructs one capture and scores it.

    Seconds are those of the reconstruction alone, decoding included. Peak memory is this process's, measuring included.

    Args:
        job: what is measured, with which settings.
        store: takes a line a frame, and the pictures.
        report: takes the printed lines.
        static: a frame 0 that was fitted before, and the seconds that it took.
        fitted: called with frame 0 and its seconds once it is fitted here.
    """
    truth, given = job.open_truth(), job.open_given()
    unseen = given.full_test_rig is not None
    if not unseen:
        report("    no test cameras: the scores are those of the training cameras (--test holds some out)")
    # These bring the kernels; the table and the command do not.
    from scas4d_core.metrics.evaluation import measure_flicker, measure_parts, measure_pictures, measure_tracks

    store.start_frames(job.key)
    count = given.frame_count if job.frames is None else min(job.frames, given.frame_count)
    lines: list[Row] = []
    with Bars(Console(stderr=True)) as bars:
        frames = reconstruct_frames(given, job.settings, count, static=static and static[0], progress=bars)
        for reconstruction, done in frames:
            index = done.index
            line: Row = {"index": index, "seconds": done.seconds, "stages": {}}
            if index == 0:
                if (first := reconstruction.report) is not None:
                    for sentence in first.warnings:
                        if sentence not in given.remarks:
                            report(f"    {sentence}")
                truth = truth if unseen else truth.with_training_as_test(reconstruction.calibrated)
            if index == 0 and static is not None:
                line["seconds"] = static[1]
            elif index == 0 and fitted is not None and reconstruction.static is not None:
                fitted(reconstruction.static, done.seconds)
            if done.report is not None:
                line["cpu_seconds"] = done.cpu_seconds
                line["stages"] = {name: float(value) for name, value in done.report.seconds.items()}
                line["moving"], line["gaussians"] = int(done.report.moving), int(done.report.gaussians)
                line["alarms"] = [
                    {"what": a.kind.value, "camera": a.camera, "evidence": a.evidence} for a in done.report.alarms
                ]
            scores, by_camera = measure_pictures(reconstruction, truth, index, with_lpips=job.lpips)
            line |= scores
            store.put_frame(job.key, {**line, "cameras": by_camera})
            lines.append(line)
            reconstruction.history.move_to_scratch(store.folder)
            report(f"    frame {index:3d}/{count - 1}  {line['psnr']:6.2f} dB  {line['seconds']:6.2f} s")
            for alarm in line.get("alarms", ()):
                report(f"      ! {alarm['camera'] or 'all cameras'}: {alarm['evidence']}")

    indices = list(range(count))
    row: Row = {
        "key": job.key,
        "variant": job.variant,
        "capture": truth.name,
        "preset": job.preset,
        "iterations": job.settings.update.iterations,
        "seed": job.settings.update.seed,
        "changes": ", ".join([word for word in (job.changes, "" if unseen else TRAINING) if word]),
        "measured_on": "test cameras" if unseen else TRAINING,
        "settings": job.record,
        "given": {"frames": count, "masks": job.masks, "points": job.points},
        "capture_frames": given.frame_count,
        "measured": datetime.now(UTC).isoformat(timespec="seconds"),
        "gaussians": len(reconstruction.history.gaussians(0)),
        "moving": int(reconstruction.history.gaussians(count - 1).moving.sum()),
        "seconds_first": lines[0]["seconds"],
        "psnr_first": lines[0]["psnr"],
        **summary(lines),
    }
    if truth.ground_truth is not None and count > 1:
        row |= measure_tracks(reconstruction, truth, indices)
        row |= measure_parts(reconstruction, truth, indices)
    if count > 1:
        row |= measure_flicker(reconstruction, truth, indices)
    row["peak_mb"] = peak_megabytes()
    folder = store.folder / "pictures" / job.key
    for index in sorted({range(count)[i] for i in job.pictures if -count <= i < count}):
        save_comparisons(reconstruction, truth, index, folder)
    if "parts_count" in row:
        save_parts(reconstruction, truth, indices[-1], reconstruction.parts(int(row["parts_count"])), folder)
    return reconstruction, row


def summary(lines: Sequence[Row]) -> Row:
    """Means of the per-frame lines over all updates (every frame but the first), for the table."""
    updates = lines[1:]
    if not updates:
        return {"updates": 0}
    from scas4d_core.metrics.evaluation import mean_scores

    names = ("psnr", "psnr_foreground", "psnr_changed", "ssim", "flip", "lpips")
    return {
        "updates": len(updates),
        **mean_scores({name: line.get(name) for name in names} for line in updates),
        "psnr_worst": min(line["psnr"] for line in updates),
        "psnr_last": updates[-1]["psnr"],
        "alarms": sum(len(line.get("alarms", ())) for line in updates),
        "psnr_by_frame": [round(line["psnr"], 3) for line in lines],
        **(_seconds(updates) if "seconds" in updates[0] else {}),  # states of a file took none
    }


def _seconds(updates: Sequence[Row]) -> Row:
    """Medians: the first update compiles or loads kernels, and they do not see it."""
    stages = dict.fromkeys(name for line in updates for name in line["stages"])
    return {
        "seconds_update": float(np.median([line["seconds"] for line in updates])),
        "cpu_seconds_update": float(np.median([line["cpu_seconds"] for line in updates])),
        "seconds_stages": {
            name: float(np.median([line["stages"].get(name, 0.0) for line in updates])) for name in stages
        },
    }


def save_comparisons(reconstruction: Committed, capture: Capture, index: int, folder: Path) -> None:
    """Saves truth | render | difference of every test camera as PNG files."""
    rig, truth = capture.test_rig, capture.test_frame(index)
    assert rig is not None
    for camera in rig.cameras:
        render = pictures.eight_bit(reconstruction.render(camera, index).colour)
        compared = pictures.comparison(truth.images[camera.name], render)
        pictures.save(folder / f"frame{index:04d}_camera{camera.name}.png", compared)


def save_parts(reconstruction: Committed, capture: Capture, index: int, labels: NDArray[Any], folder: Path) -> None:
    """Saves true | rendered part labels of every labelled test camera, in colours, as PNG files."""
    from scas4d_core.metrics.evaluation import render_parts

    truth, rig = capture.ground_truth, capture.test_rig
    assert truth is not None
    assert rig is not None
    for camera in rig.cameras:
        if camera.name in truth.label_cameras:
            true = truth.labels(camera.name, index)
            picture = np.where(true > 0, render_parts(reconstruction, camera, index, labels), 0)
            shown = np.concatenate([true, picture], axis=1).astype(np.uint8)
            pictures.save(folder / f"parts{index:04d}_camera{camera.name}.png", pictures.colour_labels(shown))


def peak_megabytes() -> float | None:
    """Largest resident memory of this process so far, 10⁶ bytes; None where the system does not report it (Windows)."""
    status = Path("/proc/self/status")
    if status.exists():  # on Linux `getrusage` reports, in a child, at least the memory of its parent
        peak = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(peak.split()[1]) * 1024 / 1e6
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
