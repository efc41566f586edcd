"""Soak test with thousands of frames of a small scene: static Gaussians, rotations, sizes and memory must not drift.

A ball circles a vertical axis six times in 500 frames, while spinning six times about its own axis. It then moves all
the way back. This round trip is repeated. Next to the ball are a resting ball that is labelled as moving, and a static
floor. After each round trip, the truth is bit-identical to that of frame 0.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from ball import rig
from numpy.typing import NDArray

from frame_cases.footage import SyntheticFootage
from frame_cases.scene import first_state, gone, rows
from scas4d_core.captures.frame import Frame
from scas4d_core.first_frame.static_result import StaticResult
from scas4d_core.gaussians import Gaussians
from scas4d_core.reconstruction import Reconstruction
from scas4d_core.settings import SceneSettings, Settings, StaticSettings, UpdateSettings
from scas4d_core.storage.history import History
from studies.constants import all_varied
from studies.wall import photograph

SIZE = 48
"""Width and height of the six images in pixels."""
OUT = 500
"""Number of frames on the outward trip."""
ROUNDS = 6
"""Number of turns around the axis on the outward trip."""
RATE = 30.0
"""Frames per second."""

SETTINGS = Settings(
    scene=SceneSettings(metres_per_unit=1.0),
    static=StaticSettings(iterations=1),
    update=UpdateSettings(iterations=20, clusters=(2, 12, 48)),
)
"""Settings with few iterations, so that the errors of each update can accumulate over thousands of frames."""

PIXEL_M = 0.023
"""Size of a pixel at the centre of the scene in metres, which is the resolution of the images."""
RESTING_M = 4 * PIXEL_M
"""Target: largest RMS distance of the resting ball from its start, in any row. An update locates a ball of ten pixels
with some error, and several errors in a row may have the same direction."""
RESTING_MEAN_M = PIXEL_M
"""Target: largest RMS distance of the resting ball from its start, averaged over a run."""
RETURN_M = PIXEL_M
"""Target: largest RMS distance of the moving ball from its start when it has returned there."""
TREND = 1.5
"""Target: largest ratio of the mean distance of the resting ball in the second half to that in the first half."""
UNIT = 1e-5
"""Target: largest deviation of a rotation's norm from 1."""
GROWTH = 10.5
"""Target: largest ratio between the lengths of an axis now and in frame 0: ``checks.SHRUNK``, plus rounding."""
HALF = 10
"""Minimum number of rows in each half of a run for checking ``RESTING_MEAN_M`` and ``TREND``."""
MEMORY = 1.1
"""Target: largest ratio of the memory in the last tenth to that in the first tenth."""


@dataclass(frozen=True)
class Row:
    """The state of the scene after a frame.

    Attributes:
        frame: frame index.
        still: whether static Gaussians are bit-identical to those in frame 0, except for their colours.
        finite: whether all values are finite.
        resting: RMS distance of the resting ball from the truth, in metres.
        moving: RMS distance of the moving ball from the truth, in metres.
        unit: largest deviation of a rotation's norm from 1.
        longest: largest ratio of an axis length to that in frame 0.
        shortest: smallest ratio of an axis length to that in frame 0.
        memory: resident memory in MB.
        degraded: number of degraded frames since the previous row.
    """

    frame: int
    still: bool
    finite: bool
    resting: float
    moving: float
    unit: float
    longest: float
    shortest: float
    memory: float
    degraded: int


def true_state(state: Gaussians, index: int) -> Gaussians:
    """Returns the ground truth of frame ``index``, given the ground truth of frame 0."""
    on = index % (2 * OUT)
    share = min(on, 2 * OUT - on) / OUT
    return gone(state, 2 * np.pi * ROUNDS * (1 - np.cos(np.pi * share)) / 2)


class Soak:
    """A run of the soak test, whose states are in a folder. Creating it again for the same folder resumes the run.

    Attributes:
        rows: the rows measured so far.
    """

    def __init__(self, folder: Path) -> None:
        self.rows: list[Row] = []
        self.first = first_state(resting_may_move=True)
        self._goes, self._rests = rows()
        self._rig = rig(SIZE)
        history = History.open(folder / "states")
        with all_varied(SyntheticFootage.constants):
            if history.indices:
                self.scene = Reconstruction.resume(self._rig, SETTINGS, history)
            else:
                static = StaticResult(self.first, {}, [])
                self.scene = Reconstruction.start(self._rig, self.frame(0), SETTINGS, history=history, static=static)

    @property
    def done(self) -> int:
        """Number of processed frames after frame 0."""
        return self.scene.history.indices[-1]

    def frame(self, index: int) -> Frame:
        """Returns a frame with the images of all cameras."""
        shown = photograph(true_state(self.first, index), self._rig)
        return Frame(index, index / RATE, shown.images, shown.masks)

    def run(self, frames: int, every: int = 100) -> list[Row]:
        """Continues the run up to a frame and returns its rows, one for every ``every`` frames."""
        degraded = 0
        while self.done < frames:
            report = self.scene.step(self.frame(self.done + 1))
            degraded += report.degraded is not None
            if self.done % every == 0 or self.done == frames:
                self.rows.append(self._measured(degraded))
                print(self.rows[-1])
                self.scene.history.retain(last=2)
                degraded = 0
        return self.rows

    def _measured(self, degraded: int) -> Row:
        before, now = self.first, self.scene.history.gaussians(self.done)
        true = true_state(before, self.done)
        stands = ~before.moving
        same = [
            np.array_equal(getattr(before, name)[stands], getattr(now, name)[stands])
            for name in ("means", "factors", "rotations")
        ]
        off = np.linalg.norm(now.means.astype(np.float64) - true.means, axis=1)
        axes = np.linalg.svd(now.factors, compute_uv=False) / np.linalg.svd(before.factors, compute_uv=False)
        return Row(
            frame=self.done,
            still=all(same),
            finite=all(bool(np.isfinite(array).all()) for array in now.arrays().values()),
            resting=_rms(off[self._rests]),
            moving=_rms(off[self._goes]),
            unit=float(np.abs(np.linalg.norm(now.rotations.astype(np.float64), axis=1) - 1).max()),
            longest=float(axes.max()),
            shortest=float(axes.min()),
            memory=resident_mb(),
            degraded=degraded,
        )


def violations(rows: Sequence[Row]) -> list[str]:
    """Returns the missed targets, one sentence each."""
    faults = []
    for row in rows:
        at = f"frame {row.frame}: "
        if not row.finite:
            faults.append(at + "a value is not finite")
        if not row.still:
            faults.append(at + "a static Gaussian has moved")
        if not row.resting <= RESTING_M:
            faults.append(
                at + f"the resting ball is {1000 * row.resting:.1f} mm from its start; the target is {RESTING_M} m"
            )
        if row.frame % (2 * OUT) == 0 and not row.moving <= RETURN_M:
            faults.append(
                at + f"the moving ball returned {1000 * row.moving:.1f} mm from its start; the target is {RETURN_M} m"
            )
        if not row.unit <= UNIT:
            faults.append(at + f"the norm of a rotation deviates from 1 by {row.unit:.1e}")
        if not (row.longest <= GROWTH and row.shortest >= 1 / GROWTH):
            faults.append(at + f"axes are {row.shortest:.2f} to {row.longest:.2f} times as long as in frame 0")
    half = len(rows) // 2
    if half >= HALF:
        early, late = (float(np.mean([row.resting for row in part])) for part in (rows[:half], rows[half:]))
        if not early + late <= 2 * RESTING_MEAN_M:
            faults.append(f"the resting ball is {500 * (early + late):.1f} mm from its start on average")
        if late > TREND * early:
            faults.append(
                f"the resting ball drifts: {1000 * early:.1f} mm in the first half, {1000 * late:.1f} mm in the second"
            )
    tenth = max(1, len(rows) // 10)
    began, ended = max(row.memory for row in rows[:tenth]), max(row.memory for row in rows[-tenth:])
    if ended > MEMORY * began:
        faults.append(f"memory grew from {began:.0f} to {ended:.0f} MB")
    return faults


def _rms(distances: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(distances))))


def resident_mb() -> float:
    """Returns the resident memory of this process in 10⁶ bytes, or NaN if it cannot be read."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmRSS"):
                return int(line.split()[1]) * 1024 / 1e6
    return math.nan
