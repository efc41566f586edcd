"""Camera timing: without genlock, cameras capture images up to half a frame before or after the other cameras.

After an update, a few cameras are measured (different cameras in each frame). Moving Gaussians move from Θ_{t−1} to Θ_t
within a frame. Renderings extrapolated forward and backward by half of this motion predict images at other times. The
capture time is the fraction of the motion that best explains the residual of the image relative to Θ_t. Measurements of
a camera are averaged with exponential forgetting. An offset that all cameras share is a tracking lag, so the median
over cameras is defined as 0. Nothing is corrected, and no state depends on these values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from math import inf, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.renderer import Renderer
from scas4d_core.frame_outcome import CameraTiming, Candidate, FrameOutcome
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.outliers import Past
from scas4d_core.update.result import UpdateResult

LOOKS, ITERATIONS = 4, 25
"""Maximum number of measured cameras per frame, and minimum number of iterations of the update per measured camera.
Measuring a camera requires two or three renderings."""
HALF = 0.5
"""Fraction of a frame's motion by which moving Gaussians are extrapolated. Larger offsets are not expected."""
STEEP = 0.02
"""Minimum change of a pixel value ([0, 1]) over half a frame that exceeds noise."""
BRIGHT = 0.98
"""Image value above which a pixel may be saturated."""
FEW, MOST = 50, 1500
"""Minimum and approximate maximum number of changing pixels that are used."""
CAUCHY, QUIETEST = 2.4, 1 / 255
"""Residual at which the Cauchy weight is one half, and lower bound on the usual residual; see ``alignment``."""
SMALLEST = 1e-6
"""Regularization of possibly singular equations, relative to the square of each unknown."""
NEIGHBOURS = 10.0
"""Approximate number of pixels with correlated errors. Variances are multiplied by this number."""
USUAL = 0.1
"""Variation of a camera's measurements in fast motion, in frames, caused by tracking lag and curved motion."""
FARTHEST = 0.75
"""Limit to which a measured offset is clamped, in frames. Motion that reverses has no measurable shift."""
LONG_GAP = 3.0
"""Duration of a frame, in multiples of the mean duration, above which the weight of a measurement decreases."""
KEEPS = 0.95
"""Factor by which each new measurement multiplies the weights of earlier ones. Effectively, the last forty count."""
ENOUGH = 2.5
"""Minimum effective number of measurements for a mean to count as known."""
CAMERAS = 4
"""Minimum number of cameras with known means for a median. With fewer, a camera that is off cannot be identified."""
APART = 0.02
"""Measured difference between the means of synchronized cameras on captures, in frames. It is added to each standard
error in quadrature."""
MAX_ERROR = 0.1
"""Maximum standard error of a reported mean, in frames."""
OFF, SURE = 0.15, 4.0
"""Minimum offset of a camera that is out of step, in frames and in multiples of its standard error. Clean captures
reach 0.05. See docs/calibration.md.
"""

Array = NDArray[np.float32]
Row = tuple[float, ...]


class PictureTiming(NamedTuple):
    """Capture time of an image relative to the state: ``offset`` in frames, positive if later, and its ``variance``."""

    offset: float
    variance: float


@dataclass(frozen=True)
class CameraTimingSums:
    """The measurements of one camera as sums with exponential forgetting.

    Attributes:
        weight: sum of weights.
        squares: sum of squared weights.
        offset: weighted sum of the offsets after the state, in seconds.
        spread: weighted sum of the squared offsets, in square seconds.
        frame: weighted sum of frame durations, in seconds.
        last: index of the last frame in which the camera was measured.
    """

    weight: float = 0.0
    squares: float = 0.0
    offset: float = 0.0
    spread: float = 0.0
    frame: float = 0.0
    last: float = -1.0

    def with_picture(self, look: PictureTiming, way: float, frame: float) -> CameraTimingSums:
        """Returns the sums with one more measurement.

        Args:
            look: the new measurement.
            way: time from Θ_{t−1} to Θ_t, in seconds.
            frame: time since the previous frame, in seconds.
        """
        weight = 1 / (NEIGHBOURS * look.variance + USUAL**2)
        usual = self.frame / self.weight if self.weight > 0 else frame
        if frame > LONG_GAP * usual:  # otherwise, a gap would count as much as all frames that it replaces
            weight *= (usual / frame) * (usual / frame)
        seconds = way * min(FARTHEST, max(-FARTHEST, look.offset))
        return CameraTimingSums(
            KEEPS * self.weight + weight,
            KEEPS**2 * self.squares + weight**2,
            KEEPS * self.offset + weight * seconds,
            KEEPS * self.spread + weight * seconds * seconds,
            KEEPS * self.frame + weight * frame,
            self.last,
        )

    @property
    def count(self) -> float:
        """Effective number of equally weighted measurements."""
        return self.weight**2 / self.squares if self.squares > 0 else 0.0

    @property
    def mean(self) -> float:
        """Mean offset after the state, in frames."""
        return self.offset / self.frame

    @property
    def error(self) -> float:
        """Standard error of the mean, in frames."""
        seconds = self.frame / self.weight
        spread = max(0.0, self.spread / self.weight - (self.offset / self.weight) ** 2) / seconds**2
        return sqrt(spread / (self.count - 1) + APART**2) if self.count > 1 else inf


def record_timing(
    past: Past, before: Gaussians, result: UpdateResult, renderer: Renderer, way: float, frame: float, index: int
) -> Past:
    """Returns the past with measurements of some of a frame's cameras, or unchanged if the frame cannot be used.

    Frames that were rejected, retried or skipped, or whose brightness changed, cannot be used. Nor can the first frames
    with motion. Excluded cameras are not measured.

    Args:
        past: usual values after the frame.
        before: previous state Θ_{t−1}.
        result: result with Θ_t, before Gaussians are added.
        renderer: renderer for the states.
        way: time between the two states, in seconds.
        frame: time since the previous frame, in seconds.
        index: index of the frame.
    """
    trace, after = result.trace, result.gaussians
    plain = result.outcome is FrameOutcome.UPDATED and len(result.attempts) == 1 and result.exposure == 1.0
    if not plain or past.updates < 2 or trace.kept is Candidate.PREVIOUS or not trace.shown:
        return past
    looks = {name: CameraTimingSums(*row) for name, row in past.timing.items()}
    views = [one for one in result.views if one.name in trace.shown and one.name not in trace.left_out]
    views = [one for one in views if not past.is_left_out(one.name)]
    views.sort(key=lambda one: looks.get(one.name, CameraTimingSums()).last)  # least recently measured first
    ahead, back = (renderer.extrapolate(before, after, share) for share in (HALF, -HALF))
    most = max(1, min(LOOKS, trace.iterations // ITERATIONS))
    # if the end was kept, its rendering exists already
    states = (ahead, back) if trace.kept is Candidate.END else (ahead, back, after)
    pictures = renderer.render_each([(state, view.camera) for view in views[:most] for state in states])
    for view in views[:most]:
        every, planes = trace.shown[view.name]
        several = islice(pictures, len(states))
        here, there, *now = (picture.features[:3, ::every, ::every].copy() for picture in several)
        shown = now[0] if now else planes[:3]
        shifts = measure_shift(view.target[:3, ::every, ::every], *(view.exposed(one) for one in (shown, here, there)))
        known = replace(looks.get(view.name, CameraTimingSums()), last=float(index))
        looks[view.name] = known if shifts is None else known.with_picture(shifts, way, frame)
    return replace(past, timing={name: astuple(one) for name, one in looks.items()})


def astuple(looks: CameraTimingSums) -> Row:
    """Returns the sums as a row of ``Past.timing``."""
    return looks.weight, looks.squares, looks.offset, looks.spread, looks.frame, looks.last


def measure_shift(target: Array, shown: Array, ahead: Array, back: Array) -> PictureTiming | None:
    """Returns the capture time of an image, or None if too little of it changes.

    The residual is regressed on the motion, on the curvature of the motion (second difference of the three renderings),
    and on a global gain and offset.

    Args:
        target: [3, H, W] image.
        shown: [3, H, W] rendering of Θ_t.
        ahead, back: [3, H, W] renderings of Θ_t extrapolated by half a frame forward and backward.
    """
    change = np.maximum(np.abs(ahead - shown), np.abs(shown - back)).max(axis=0)
    pixels = np.flatnonzero((change > STEEP) & (target.max(axis=0) < BRIGHT))
    if len(pixels) < FEW:
        return None
    pixels = pixels[:: -(-len(pixels) // MOST)]
    here = [one.reshape(3, -1)[:, pixels].reshape(-1).astype(np.float64) for one in (target, shown, ahead, back)]
    residual, way, bend = here[0] - here[1], (here[2] - here[3]) / (2 * HALF), here[2] - 2 * here[1] + here[3]
    terms, weights = np.stack([way, bend, here[1], np.ones_like(way)]), np.ones_like(way)
    for last in (False, False, True):
        matrix = (terms * weights) @ terms.T
        inverse = np.linalg.inv(matrix + np.diag(SMALLEST * np.diag(matrix) + np.finfo(np.float32).tiny))
        numbers = inverse @ ((terms * weights) @ residual)
        left = residual - numbers @ terms
        if not last:
            usual = max(QUIETEST, 1.4826 * float(np.median(np.abs(left))))
            weights = 1 / (1 + np.square(left / (CAUCHY * usual)))
    variance = float(weights @ np.square(left) / weights.sum() * inverse[0, 0])
    return PictureTiming(
        float(numbers[0] / min(2.0, max(0.5, 1 + numbers[2]))), variance
    )  # the gain scales the change as well


def timings(past: Past) -> dict[str, CameraTiming]:
    """Returns the relative capture time of each camera that has been measured accurately enough.

    Returns an empty dictionary if there are fewer than ``CAMERAS`` such cameras.
    """
    looks = {name: CameraTimingSums(*row) for name, row in past.timing.items()}
    known = {name: one for name, one in looks.items() if one.count >= ENOUGH and one.error <= MAX_ERROR}
    if len(known) < CAMERAS:
        return {}
    common = median(one.mean for one in known.values())
    return {name: _timing(one.mean - common, one.error) for name, one in known.items()}


def _timing(frames: float, error: float) -> CameraTiming:
    return {"frames": frames, "error": error, "out_of_step": abs(frames) >= max(OFF, SURE * error)}
