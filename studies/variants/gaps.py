"""Skipped frames: accuracy of an update every few frames, compared with updates of all frames.

A scene whose cameras are faster than its updates, and that skips frames when its queue is full, commits such a
sequence. Frame indices and times are those of the capture. Both runs share one frame 0, and are compared on the frames
that both commit. The run with gaps always ends with the last multiple of the step.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from client.cli.evaluate import Report
from scas4d_core.captures import Capture
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.metrics.evaluation import measure_pictures, measure_tracks
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings

TARGET_DB = -0.7
"""Target: smallest mean difference between the run with gaps and the run without, in dB."""


@dataclass(frozen=True)
class GapResult:
    """Result of one capture.

    Attributes:
        capture: name of the capture.
        frames: indices of the compared frames.
        psnr: PSNR of each compared frame without gaps, on test cameras, in dB.
        psnr_gaps: the same with gaps.
        seconds: median seconds per update, without and with gaps.
        lost: number of lost parts (`metrics.lost_parts`) without and with gaps; None without ground truth.
        track: median 3D track error without and with gaps, in % of the extent; None without ground truth.
        outcomes: outcomes other than "updated" in the run with gaps, with their frames.
    """

    capture: str
    frames: Sequence[int]
    psnr: Sequence[float]
    psnr_gaps: Sequence[float]
    seconds: tuple[float, float]
    lost: tuple[float | None, float | None]
    track: tuple[float | None, float | None]
    outcomes: Sequence[str]

    @property
    def differences(self) -> list[float]:
        """PSNR with gaps minus PSNR without, per compared frame, in dB."""
        return [gaps - full for full, gaps in zip(self.psnr, self.psnr_gaps, strict=True)]


def measure(given: Capture, truth: Capture, settings: Settings, frames: int | None, step: int) -> GapResult:
    """Reconstructs a capture without gaps and with a gap before every frame.

    Args:
        given: capture at full size.
        truth: the same capture with test cameras, at the image scale of the settings.
        settings: settings of the reconstruction.
        frames: number of frames of the capture to use; None for all.
        step: difference between the indices of the committed frames.
    """
    count = min(frames or given.frame_count, given.frame_count)
    compared = list(range(step, count, step))
    full = _run(given, truth, settings, range(compared[-1] + 1), compared, None)
    gaps = _run(given, truth, settings, [0, *compared], compared, full.static)
    return GapResult(
        truth.name,
        compared,
        full.psnr,
        gaps.psnr,
        (full.seconds, gaps.seconds),
        (full.scores.get("parts_lost"), gaps.scores.get("parts_lost")),
        (full.scores.get("track_3d_median"), gaps.scores.get("track_3d_median")),
        gaps.outcomes,
    )


@dataclass(frozen=True)
class _Run:
    static: StaticResult
    psnr: list[float]
    seconds: float
    scores: dict[str, float | None]
    outcomes: list[str]


def _run(
    given: Capture,
    truth: Capture,
    settings: Settings,
    frames: Sequence[int],
    compared: Sequence[int],
    static: StaticResult | None,
) -> _Run:
    scene = Reconstruction.start(given.rig, given.frame(0), settings, points=given.points, static=static)
    assert scene.static is not None
    psnr, seconds, outcomes = [], [], []
    for index in frames[1:]:
        report = scene.step(given.frame(index))
        seconds.append(sum(report.seconds.values()))
        if report.outcome != "updated":
            outcomes.append(f"{index} {report.outcome}")
        if index in compared:
            value = measure_pictures(scene, truth, index)[0]["psnr"]
            assert value is not None
            psnr.append(value)
    scores = {} if truth.ground_truth is None else measure_tracks(scene, truth, [0, *compared])
    return _Run(scene.static, psnr, statistics.median(seconds), scores, outcomes)


def page(results: Sequence[GapResult], step: int) -> str:
    """Returns the results as a Markdown table."""
    lines = [
        f"An update every {step} frames, compared with updates of all frames, on the frames that both commit:",
        "",
        "| capture | frames | dB without gaps | with gaps: mean (worst frame) | lost parts | track error, % | "
        "time of an update | outcomes other than updated |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in results:
        mean, worst = statistics.fmean(one.differences), min(one.differences)
        lines.append(
            f"| {one.capture} | {len(one.frames)} | {statistics.fmean(one.psnr):.2f} | {mean:+.2f} ({worst:+.2f}) dB | "
            f"{_pair(one.lost, '.0f')} | {_pair(one.track, '.2f')} | "
            f"{one.seconds[1] / one.seconds[0]:.2f} × | {', '.join(one.outcomes)} |"
        )
    reached = sum(statistics.fmean(one.differences) >= TARGET_DB and not one.lost[1] for one in results)
    lines += ["", f"{reached} of {len(results)} captures within {TARGET_DB} dB and without lost parts."]
    return "\n".join(lines)


def _pair(values: tuple[float | None, float | None], form: str) -> str:
    return " → ".join("–" if value is None else format(value, form) for value in values)


def run(jobs: Sequence[tuple[Capture, Capture, Settings]], frames: int | None, step: int, report: Report) -> str:
    """Measures captures one after another, and returns the table."""
    results = []
    for given, truth, settings in jobs:
        results.append(measure(given, truth, settings, frames, step))
        report(page(results[-1:], step))
    return page(results, step)
