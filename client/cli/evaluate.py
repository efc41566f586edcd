"""`scas4d evaluate`: reconstructs a capture and scores the result on test cameras and ground truth."""

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
from client.exports.sources import STATES
from client.importers.open_source import CaptureOptions
from client.left_out import LeftOut
from client.progress import Bars
from scas4d_core.captures import Capture, CaptureError
from scas4d_core.errors import InputError
from scas4d_core.presets import preset
from scas4d_core.settings import Settings

if TYPE_CHECKING:
    from scas4d_core.first_frame.static_result import StaticResult
    from scas4d_core.metrics.evaluation import Committed
    from scas4d_core.reconstruction import Reconstruction

Report = Callable[[str], None]
"""Callback that receives each printed line."""


DEFAULT_OPTIONS = CaptureOptions()

TRAINING = "training cameras"
"""Marks a row that was scored on training images because the capture has no test cameras."""


@dataclass(frozen=True)
class Job:
    """Evaluation job that produces one row of the score table.

    Attributes:
        capture: capture folder.
        preset: preset name, shown in the table.
        settings: complete reconstruction settings.
        frames: number of frames to reconstruct; None for all.
        masks: whether the method is given the masks (the evaluation always uses them).
        points: whether the method is given the initial point cloud.
        pictures: indices of the frames whose comparison images are saved; negative indices count from the end.
        lpips: whether to also compute LPIPS, which loads torch.
        constants: constants of the method that a study overrides, as (dotted name, value); stored with the row.
        options: options for reading the capture.
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
        """Opens the capture as the method sees it: at full size, without the withheld inputs."""
        use_masks = self.masks and self.options.use_masks
        return self.options.open(self.capture, use_masks=use_masks, use_points=self.points)

    def open_truth(self) -> Capture:
        """Opens the capture for evaluation, at the resolution of the renders.

        If the capture has no test cameras, its training cameras are used as test cameras.
        """
        truth = self.options.open(self.capture, image_scale=self.settings.scene.image_scale)
        return truth if truth.full_test_rig is not None else truth.with_training_as_test()

    @property
    def record(self) -> Row:
        """Settings and constants as stored in the row."""
        return settings_record(self.settings, self.constants)

    @property
    def variant(self) -> str:
        """Row name without the capture: preset, iterations, seed, and a digest of all other settings."""
        update = self.settings.update
        given: Row = {"frames": self.frames, "masks": self.masks, "points": self.points}
        if self.lpips:
            given["lpips"] = True
        given |= self.options.changed
        return f"{self.preset}-{update.iterations}-s{update.seed}-{digest(self.record, given)}"

    @property
    def changes(self) -> str:
        """Table text that lists withheld inputs and differences from the preset other than iterations and seed."""
        usual = preset(self.preset).model_dump(mode="json")
        words = [
            f"{name}={json.dumps(value, separators=(',', ':'))}"
            for name, value in format_changes(self.record, usual).items()
            if name not in ("update.iterations", "update.seed", "static.seed")
            and (name, value) != ("static.seconds", None)  # studies set no time limit
        ]
        words += ["no masks"] * (not self.masks) + ["no points"] * (not self.points)
        words += [f"held out {', '.join(self.options.test)}"] if self.options.test else []
        words += [f"{name}={value}" for name, value in self.options.changed.items() if name != "test"]
        return ", ".join(words)

    @property
    def key(self) -> str:
        """Unique row name for this capture and combination of settings."""
        return f"{self.capture.resolve().name}-{self.variant}"


def settings_record(settings: Settings, constants: Sequence[tuple[str, Any]]) -> Row:
    """Returns the settings as JSON values, with the overridden constants of the method, if any."""
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
    """Scores a capture, prints the table, and writes the row, per-frame lines, images and table.md to `out`.

    Args:
        folder: capture folder. Without test cameras, its training cameras are scored and the row is marked.
        out: output folder; if it already contains the scores, they are printed without another reconstruction.
        options: options for reading the capture.
        frames: number of frames; None for all.
        preset_name: preset name.
        changes: nested settings that override the preset.
        again: whether to measure again even if `out` already contains the scores.
        report: callback that receives each printed line.

    Raises:
        CaptureError: the capture cannot be read.
        InputError: `out` contains a reconstruction without scores.
    """
    if (out / STATES).exists() and not (out / "rows").exists():
        raise InputError(
            f"out {str(out)!r} contains a reconstruction, but no scores",
            f"use --states {out} and another folder for --out to score it",
        )
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
        report(f"[1/1] {job.key}: already measured")
    table = score_tables([row])
    (out / "table.md").write_text(table + "\n")
    report(table)
    return row


def score_tables(rows: Sequence[Row], stages_of: Sequence[Row] | None = None) -> str:
    """Returns the Markdown table of scores, followed by the table of seconds per stage if there were updates."""
    table = markdown(rows)
    if stages := stage_table(rows if stages_of is None else stages_of):
        table += f"\n\nMedian seconds per update, by stage:\n\n{stages}"
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

    Times cover only the reconstruction, including decoding. Peak memory covers the whole process, including the
    evaluation.

    Args:
        job: capture to measure, with its settings.
        store: storage for the per-frame lines and the images.
        report: callback that receives each printed line.
        static: previously fitted frame 0 and its fitting time in seconds; None to fit it here.
        fitted: callback that receives frame 0 and its fitting time in seconds, if it is fitted here.

    Returns:
        The reconstruction and the measured row.

    Raises:
        CaptureError, ImageError: if an image to score cannot be used, or a frame has too few usable images.
    """
    truth, given = job.open_truth(), job.open_given()
    unseen = given.full_test_rig is not None
    if not unseen:
        report("    no test cameras: scoring the training cameras instead (use --test to hold some out)")
    # Imported lazily: this loads the kernels, which printing an existing table does not need.
    from scas4d_core.metrics.evaluation import measure_pictures

    store.start_frames(job.key)
    count = given.frame_count if job.frames is None else min(job.frames, given.frame_count)
    lines: list[Row] = []
    left_out = LeftOut(given.rig)

    def note(message: str) -> None:
        if left_out.frames:
            raise CaptureError(f"{given.name}: {message}; scores need every frame")
        if not unseen:
            raise CaptureError(f"{given.name}: {message}; scores of training cameras need every image")
        report(f"    {message}")

    with Bars(Console(stderr=True)) as bars:
        frames = reconstruct_frames(
            given, job.settings, count, static=static and static[0], progress=bars, left_out=left_out, on_message=note
        )
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
    folder = store.folder / "pictures" / job.key
    row |= score_sequence(reconstruction, truth, indices, job.pictures, folder)
    if "parts_count" in row:
        save_parts(reconstruction, truth, indices[-1], reconstruction.parts(int(row["parts_count"])), folder)
    return reconstruction, row


def score_sequence(scene: Committed, truth: Capture, indices: Sequence[int], shown: Sequence[int], folder: Path) -> Row:
    """Scores the tracks, parts and flicker of a sequence, and saves comparison images of some frames.

    Args:
        scene: committed states.
        truth: capture with the test cameras.
        indices: frames of the sequence.
        shown: positions in `indices` of the frames to save; negative ones count from the end.
        folder: folder for the images.
    """
    from scas4d_core.metrics.evaluation import measure_flicker, measure_parts, measure_tracks

    row: Row = {}
    if len(indices) > 1:
        if truth.ground_truth is not None:
            row |= measure_tracks(scene, truth, indices)
            row |= measure_parts(scene, truth, indices)
        row |= measure_flicker(scene, truth, indices)
    row["peak_mb"] = peak_megabytes()
    for index in sorted({indices[i] for i in shown if -len(indices) <= i < len(indices)}):
        save_comparisons(scene, truth, index, folder)
    return row


def summary(lines: Sequence[Row]) -> Row:
    """Summarizes the per-frame lines over all updates (every frame but the first), for the table."""
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
        **(_seconds(updates) if "seconds" in updates[0] else {}),  # states read from a file have no timings
    }


def _seconds(updates: Sequence[Row]) -> Row:
    """Returns the median times of the updates.

    A mean would include the time that the first update takes to compile or load kernels.
    """
    stages = dict.fromkeys(name for line in updates for name in line["stages"])
    return {
        "seconds_update": float(np.median([line["seconds"] for line in updates])),
        "cpu_seconds_update": float(np.median([line["cpu_seconds"] for line in updates])),
        "seconds_stages": {
            name: float(np.median([line["stages"].get(name, 0.0) for line in updates])) for name in stages
        },
    }


def save_comparisons(reconstruction: Committed, capture: Capture, index: int, folder: Path) -> None:
    """Saves ground truth | render | difference images of every test camera as PNG files."""
    rig, truth = capture.test_rig, capture.test_frame(index)
    assert rig is not None
    for camera in rig.cameras:
        render = pictures.eight_bit(reconstruction.render(camera, index).colour)
        compared = pictures.comparison(truth.images[camera.name], render)
        pictures.save(folder / f"frame{index:04d}_camera{camera.name}.png", compared)


def save_parts(reconstruction: Committed, capture: Capture, index: int, labels: NDArray[Any], folder: Path) -> None:
    """Saves ground truth | rendered part labels of every labelled test camera as coloured PNG files."""
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
    """Returns the peak resident memory of this process in 10⁶ bytes; None if unknown (on Windows)."""
    status = Path("/proc/self/status")
    if status.exists():  # on Linux, `getrusage` in a child process also counts its parent's peak
        peak = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM:"))
        return int(peak.split()[1]) * 1024 / 1e6
    try:
        import resource
    except ImportError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
