"""Updates that are too slow for the cameras: accuracy with skipped frames, and with shorter updates.

The runs share one frame 0, and are compared with updates of all frames, on the frames that they commit:

- "gaps": an update every few frames;
- "shorter updates": updates of all frames, with as many iterations in total;
- "policy skip": what a scene with ``when_full: "skip"`` does. On a virtual clock, an update with the usual number of
  iterations takes as long as a few frames. The queue, the skipped frames and the shortened updates follow the rules of
  the service. The first update takes no time, because the capture would otherwise be over.

Frame indices and times are those of the capture.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from client.cli.evaluate import Report
from client.cli.scores import Column, Row, markdown
from client.wire import Budget
from scas4d_core.captures import Capture
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.metrics.evaluation import Scores, measure_pictures, measure_tracks
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import Settings
from server.keep_up import with_fewer_iterations

TARGET_DB = -0.7
"""Target: smallest mean difference from the run without gaps, in dB."""


@dataclass(frozen=True)
class GapRun:
    """Scores of one run.

    Attributes:
        name: name in the table.
        psnr: PSNR of each committed frame on test cameras, in dB, keyed by frame.
        lost: number of lost parts (`metrics.lost_parts`), or None without ground truth.
        track: median 3D track error in % of the extent, or None without ground truth.
    """

    name: str
    psnr: Mapping[int, float]
    lost: float | None
    track: float | None


@dataclass(frozen=True)
class GapResult:
    """Result of one capture.

    Attributes:
        capture: name of the capture.
        full: run with updates of all frames.
        runs: the other runs.
    """

    capture: str
    full: GapRun
    runs: Sequence[GapRun]

    def differences(self, run: GapRun) -> list[float]:
        """Returns the PSNR of each frame of a run minus that of the run with all frames, in dB."""
        return [value - self.full.psnr[index] for index, value in run.psnr.items()]

    def reached(self, run: GapRun) -> bool:
        """Returns whether a run is within the target and loses no part that the run with all frames keeps."""
        return statistics.fmean(self.differences(run)) >= TARGET_DB and (run.lost or 0) <= (self.full.lost or 0)


class Queue:
    """Queue of a scene that skips frames, on a virtual clock whose unit is the interval between two frames.

    Args:
        count: number of frames, of which frame 0 is already committed.
        length: maximum number of unfinished frames (``queue_frames``).

    >>> queue = Queue(9, 4)
    >>> queue.next(), queue.waiting
    (1, 0)
    >>> queue.spend(5.0)  # frames 2, 3 and 4 wait; frame 5 finds the queue full; frame 6 waits behind it
    >>> queue.next(), queue.waiting
    (5, 1)
    """

    def __init__(self, count: int, length: int) -> None:
        self._count, self._length = count, length
        self._waiting: list[int] = []
        self._now, self._arrived = 1.0, 0

    @property
    def waiting(self) -> int:
        """Number of frames that are waiting."""
        return len(self._waiting)

    def next(self) -> int | None:
        """Returns the next frame to update, or None after the last one."""
        self._arrive(busy=0)
        if not self._waiting and self._arrived + 1 < self._count:
            self._now = self._arrived + 1
            self._arrive(busy=0)
        return self._waiting.pop(0) if self._waiting else None

    def spend(self, intervals: float) -> None:
        """Advances the clock by the duration of an update."""
        self._now += intervals
        self._arrive(busy=1)

    def _arrive(self, busy: int) -> None:
        while self._arrived + 1 < min(self._count, self._now + 1e-9):
            self._arrived += 1
            if len(self._waiting) + busy >= self._length:
                self._waiting.clear()
            self._waiting.append(self._arrived)


def measure(
    given: Capture, truth: Capture, settings: Settings, frames: int | None, step: int, queue_frames: int
) -> GapResult:
    """Runs the comparison on one capture.

    Args:
        given: capture at full size.
        truth: the same capture with test cameras, at the image scale of the settings.
        settings: settings of the reconstruction.
        frames: number of frames of the capture to use; None for all.
        step: number of frames that arrive during an update.
        queue_frames: maximum number of unfinished frames.
    """
    count = min(frames or given.frame_count, given.frame_count)
    usual = settings.update.iterations
    with_gaps = range(step, count, step)
    static: StaticResult | None = None

    def run(name: str, indices: Iterator[int], iterations: Callable[[], int], done: Callable[[int], None]) -> GapRun:
        nonlocal static
        scene = Reconstruction.start(given.rig, given.frame(0), settings, points=given.points, static=static)
        static = scene.static
        psnr: dict[int, float] = {}
        for index in indices:
            scene.set_budget(iterations=iterations())
            done(scene.step(given.frame(index)).iterations)
            value = measure_pictures(scene, truth, index)[0]["psnr"]
            assert value is not None
            psnr[index] = value
        scores: Scores = {} if truth.ground_truth is None else measure_tracks(scene, truth, [0, *psnr])
        return GapRun(name, psnr, scores.get("parts_lost"), scores.get("track_3d_median"))

    queue = Queue(count, queue_frames)

    def shortened() -> int:
        return with_fewer_iterations(Budget(), queue.waiting, usual).iterations or usual

    warm = False

    def spend(iterations: int) -> None:
        nonlocal warm
        queue.spend(step * iterations / usual if warm else 0)
        warm = True

    full = run("all frames", iter(range(1, count)), lambda: usual, lambda _: None)
    gaps = run("gaps", iter(with_gaps), lambda: usual, lambda _: None)
    shorter = run("shorter updates", iter(range(1, count)), lambda: max(1, usual // step), lambda _: None)
    policy = run("policy skip", iter(queue.next, None), shortened, spend)
    return GapResult(truth.name, full, [gaps, shorter, policy])


COLUMNS = (
    Column("capture", "capture"),
    Column("run", "name"),
    Column("frames", "frames", "d"),
    Column("mean difference, dB", "mean", "+.2f"),
    Column("worst frame", "worst", "+.2f"),
    Column("lost parts", "lost", ".0f"),
    Column("track error, %", "track"),
)


def page(results: Sequence[GapResult], step: int) -> str:
    """Returns the results as a Markdown table."""
    rows: list[Row] = []
    for one in results:
        for run in (one.full, *one.runs):
            off = one.differences(run)
            figures = {"frames": len(off), "mean": statistics.fmean(off), "worst": min(off)}
            rows.append({"capture": one.capture, **vars(run), **figures})
    lines = [f"Updates that take as long as {step} frames, compared with updates of all frames:", ""]
    lines += [markdown(rows, COLUMNS), "", f"Captures within {TARGET_DB} dB and without further lost parts:"]
    for place, name in enumerate(run.name for run in results[0].runs):
        reached = sum(one.reached(one.runs[place]) for one in results)
        lines.append(f"- {name}: {reached} of {len(results)}")
    return "\n".join(lines)


def run(
    jobs: Sequence[tuple[Capture, Capture, Settings]],
    frames: int | None,
    step: int,
    queue_frames: int,
    report: Report,
) -> str:
    """Measures captures one after another, and returns the table."""
    results = []
    for given, truth, settings in jobs:
        results.append(measure(given, truth, settings, frames, step, queue_frames))
        report(page(results[-1:], step))
    return page(results, step)
