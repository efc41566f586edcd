"""Updates that are too slow for the cameras: accuracy with skipped frames, and with shorter updates of all frames.

Three runs share one frame 0 and are compared on the same frames: updates of all frames, an update every few frames,
and updates of all frames with as many iterations in total as in the second run. The second run corresponds to a scene
that skips frames, the third one to a scene that keeps up. Frame indices and times are those of the capture.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from client.cli.evaluate import Report
from scas4d_core.captures import Capture
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.metrics.evaluation import Scores, measure_pictures, measure_tracks
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings

TARGET_DB = -0.7
"""Target: smallest mean difference from the run without gaps, in dB."""


@dataclass(frozen=True)
class GapRun:
    """Scores of one run.

    Attributes:
        psnr: PSNR of each compared frame on test cameras, in dB.
        seconds: median seconds per update.
        lost: number of lost parts (`metrics.lost_parts`), or None without ground truth.
        track: median 3D track error in % of the extent, or None without ground truth.
    """

    psnr: Sequence[float]
    seconds: float
    lost: float | None
    track: float | None


@dataclass(frozen=True)
class GapResult:
    """Result of one capture: the runs with all frames, with gaps, and with shorter updates."""

    capture: str
    full: GapRun
    gaps: GapRun
    shorter: GapRun

    def differences(self, run: GapRun) -> list[float]:
        """Returns the PSNR of a run minus that of the run with all frames, per compared frame, in dB."""
        return [value - full for full, value in zip(self.full.psnr, run.psnr, strict=True)]

    def reached(self, run: GapRun) -> bool:
        """Returns whether a run is within the target and loses no part that the run with all frames keeps."""
        return statistics.fmean(self.differences(run)) >= TARGET_DB and (run.lost or 0) <= (self.full.lost or 0)


def measure(given: Capture, truth: Capture, settings: Settings, frames: int | None, step: int) -> GapResult:
    """Runs the comparison on one capture.

    Args:
        given: capture at full size.
        truth: the same capture with test cameras, at the image scale of the settings.
        settings: settings of the reconstruction.
        frames: number of frames of the capture to use; None for all.
        step: difference between the indices of the compared frames.
    """
    count = min(frames or given.frame_count, given.frame_count)
    compared = list(range(step, count, step))
    everything = list(range(compared[-1] + 1))
    full, static = _run(given, truth, settings, everything, compared, None)
    gaps, _ = _run(given, truth, settings, [0, *compared], compared, static)
    iterations = max(1, settings.update.iterations // step)
    fewer = settings.model_copy(update={"update": settings.update.model_copy(update={"iterations": iterations})})
    shorter, _ = _run(given, truth, fewer, everything, compared, static)
    return GapResult(truth.name, full, gaps, shorter)


def _run(
    given: Capture,
    truth: Capture,
    settings: Settings,
    frames: Sequence[int],
    compared: Sequence[int],
    static: StaticResult | None,
) -> tuple[GapRun, StaticResult]:
    scene = Reconstruction.start(given.rig, given.frame(0), settings, points=given.points, static=static)
    assert scene.static is not None
    psnr, seconds = [], []
    for index in frames[1:]:
        seconds.append(sum(scene.step(given.frame(index)).seconds.values()))
        if index in compared:
            value = measure_pictures(scene, truth, index)[0]["psnr"]
            assert value is not None
            psnr.append(value)
    scores: Scores = {} if truth.ground_truth is None else measure_tracks(scene, truth, [0, *compared])
    run = GapRun(psnr, statistics.median(seconds), scores.get("parts_lost"), scores.get("track_3d_median"))
    return run, scene.static


def page(results: Sequence[GapResult], step: int) -> str:
    """Returns the results as a Markdown table."""
    lines = [
        f"Every {step}th frame, compared with updates of all frames:",
        "",
        "| capture | run | PSNR, dB | mean difference (worst frame), dB | lost parts | track error, % | "
        "seconds per update |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in results:
        for name, run in (("all frames", one.full), ("gaps", one.gaps), ("shorter updates", one.shorter)):
            off = one.differences(run)
            lines.append(
                f"| {one.capture} | {name} | {statistics.fmean(run.psnr):.2f} | {statistics.fmean(off):+.2f} "
                f"({min(off):+.2f}) | {_number(run.lost, '.0f')} | {_number(run.track, '.2f')} | {run.seconds:.2f} |"
            )
    gaps = sum(one.reached(one.gaps) for one in results)
    shorter = sum(one.reached(one.shorter) for one in results)
    lines += [
        "",
        f"Within {TARGET_DB} dB and without further lost parts: {gaps} of {len(results)} captures with gaps, {shorter} "
        "with shorter updates.",
    ]
    return "\n".join(lines)


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def run(jobs: Sequence[tuple[Capture, Capture, Settings]], frames: int | None, step: int, report: Report) -> str:
    """Measures captures one after another, and returns the table."""
    results = []
    for given, truth, settings in jobs:
        results.append(measure(given, truth, settings, frames, step))
        report(page(results[-1:], step))
    return page(results, step)
