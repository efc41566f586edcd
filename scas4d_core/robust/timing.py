"""Timing of the cameras: without genlock a camera's pictures are taken up to half a frame before or after the others'.

After an update a few cameras, others in each frame, are looked at. What moves goes from Θ_{t−1} to Θ_t in a frame;
rendered half of that way on and half of it back, it shows what a picture of another moment would show. The picture's
residual on Θ_t is explained by both, and the share of the way that explains it is the moment at which the picture was
taken. Looks of a camera make a mean that forgets. What all cameras share is motion that is followed late: the median
over the cameras is taken for 0. Nothing is done about it: no state hangs on these figures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, sqrt
from statistics import median
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import TrainingView
from scas4d_core.frame_outcome import CameraTiming, Candidate, FrameOutcome
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.outliers import Past
from scas4d_core.update.result import UpdateResult

LOOKS, ITERATIONS = 4, 25
"""Cameras that are looked at in a frame at most, one for so many iterations of its update: two renderings each."""
HALF = 0.5
"""Of the way of a frame, that what moves is rendered on and back: a camera is off by no more."""
STEEP = 0.02
"""Of a value 0…1 in half a frame, above which a pixel's change is more than noise."""
BRIGHT = 0.98
"""Value of a picture from which it may be cut off."""
FEW, MOST = 50, 1500
"""Changing pixels: fewer are not enough, and of more about this many are used."""
CAUCHY, QUIETEST = 2.4, 1 / 255
"""As those of ``effects.cameras.alignment``: residuals beyond have less weight, and rounding is no residual."""
SMALLEST = 1e-6
"""Of each number's own square, added to equations that may have no solution."""
NEIGHBOURS = 10.0
"""Pixels that err alike, about: variances are larger by so much than those of pixels that err one by one."""
USUAL = 0.1
"""Of a frame, that looks of one camera differ by where motion is fast: what it is followed late by, and bends."""
FARTHEST = 0.75
"""Of a frame, from which a look says no more than that: motion that turns back has no measurable shift."""
KEEPS = 0.95
"""Weight of the looks before, at each look: about the last forty count."""
ENOUGH = 2.5
"""Looks of about the same weight, from which a camera's mean is known."""
CAMERAS = 4
"""That are known, of which a median is taken: with fewer it cannot be decided which is off."""
APART = 0.02
"""Of a frame, that the means of cameras differ by on captures whose cameras are in step, as far as can be measured on
these: added to each error."""
MAX_ERROR = 0.1
"""Error, of a frame, from which a camera's mean is too little known to be reported."""
OFF, SURE = 0.15, 4.0
"""Frames, and times its error, by which a camera is clearly out of step; clean: 0.05. docs/calibration.md has more."""

Array = NDArray[np.float32]
Row = tuple[float, ...]


class PictureTiming(NamedTuple):
    """Moment of one picture: ``offset`` of a frame's way after the state (+) or before it (−); its ``variance``."""

    offset: float
    variance: float


@dataclass(frozen=True)
class CameraTimingSums:
    """The looks at one camera, as sums that forget.

    Attributes:
        weight, squares: of the looks, and of the squares of their weights. offset, spread: seconds after the state,
            weighed, and their squares. frame: seconds of a frame, weighed. last: index of the frame of the last look.
    """

    weight: float = 0.0
    squares: float = 0.0
    offset: float = 0.0
    spread: float = 0.0
    frame: float = 0.0
    last: float = -1.0

    def with_picture(self, look: PictureTiming, way: float, frame: float) -> CameraTimingSums:
        """With one more; ``way``: seconds from Θ_{t−1} to Θ_t, ``frame``: from the frame before."""
        weight = 1 / (NEIGHBOURS * look.variance + USUAL**2)
        seconds = way * min(FARTHEST, max(-FARTHEST, look.offset))
        return CameraTimingSums(
            KEEPS * self.weight + weight,
            KEEPS**2 * self.squares + weight**2,
            KEEPS * self.offset + weight * seconds,
            KEEPS * self.spread + weight * seconds**2,
            KEEPS * self.frame + weight * frame,
            self.last,
        )

    @property
    def count(self) -> float:
        """Number of equally weighted looks with the same information."""
        return self.weight**2 / self.squares if self.squares > 0 else 0.0

    @property
    def mean(self) -> float:
        """Frames after the state."""
        return self.offset / self.frame

    @property
    def error(self) -> float:
        """Standard error of the mean, frames."""
        seconds = self.frame / self.weight
        spread = max(0.0, self.spread / self.weight - (self.offset / self.weight) ** 2) / seconds**2
        return sqrt(spread / (self.count - 1) + APART**2) if self.count > 1 else inf


def record_timing(
    past: Past, before: Gaussians, result: UpdateResult, renderer: Renderer, way: float, frame: float, index: int
) -> Past:
    """The past with the looks at some cameras of a frame; the same where it says nothing.

    That is a frame that was rejected, retried, skipped or lit differently, the first that moved, which no motion led,
    and any on a GPU, where no rendering is kept. A camera that is left out says nothing either.

    Args:
        past: after the frame. before: Θ_{t−1}. result: Θ_t, before anything is born. renderer: draws.
        way: seconds between the two. frame: seconds since the frame before. index: of the frame.
    """
    trace, after = result.trace, result.gaussians
    plain = result.outcome is FrameOutcome.UPDATED and len(result.attempts) == 1 and result.exposure == 1.0
    if not plain or past.updates < 2 or trace.kept is Candidate.PREVIOUS or not trace.shown:
        return past
    looks = {name: CameraTimingSums(*row) for name, row in past.timing.items()}
    views = [one for one in result.views if one.name in trace.shown and one.name not in trace.left_out]
    views = [one for one in views if not past.is_left_out(one.name)]
    views.sort(
        key=lambda one: looks.get(one.name, CameraTimingSums()).last
    )  # who has waited longest, in the rig's order
    (ahead, back), most = half_frame_states(before, after), max(1, min(LOOKS, trace.iterations // ITERATIONS))
    for view in views[:most]:
        every, planes = trace.shown[view.name]
        states = (ahead, back) if trace.kept is Candidate.END else (ahead, back, after)  # the end was shown
        here, there, *now = (_rendered(renderer, state, view)[:, ::every, ::every].copy() for state in states)
        shown = now[0] if now else planes[:3]
        shifts = measure_shift(
            view.target[:3, ::every, ::every], *(_exposed(view, one) for one in (shown, here, there))
        )
        known = replace(looks.get(view.name, CameraTimingSums()), last=float(index))
        looks[view.name] = known if shifts is None else known.with_picture(shifts, way, frame)
    return replace(past, timing={name: astuple(one) for name, one in looks.items()})


def astuple(looks: CameraTimingSums) -> Row:
    """As ``Past.timing`` has it."""
    return looks.weight, looks.squares, looks.offset, looks.spread, looks.frame, looks.last


def half_frame_states(before: Gaussians, after: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Θ_t half of a frame on and half of it back, along the way from Θ_{t−1}; only places and shapes change."""
    rows = np.flatnonzero(after.moving)
    ways = [(name, HALF * (getattr(after, name)[rows] - getattr(before, name)[rows])) for name in ("means", "factors")]
    states = []
    for sign in (1, -1):
        arrays = {name: getattr(after, name).copy() for name, _ in ways}
        for name, way in ways:
            arrays[name][rows] += np.float32(sign) * way
        states.append(after.replace(**arrays))
    return states[0], states[1]


def _rendered(renderer: Renderer, state: Gaussians, view: TrainingView) -> Array:
    return renderer.render(state, view.camera).features[:3]


def _exposed(view: TrainingView, shown: Array) -> Array:
    exposed: Array = view.exposure[:3, 0, None, None] * shown + view.exposure[:3, 1, None, None]
    return exposed


def measure_shift(target: Array, shown: Array, ahead: Array, back: Array) -> PictureTiming | None:
    """The moment of a picture; None: too little of it changes.

    Of its residual what goes with the change is separated from what goes with the bend of the change, which is that
    of a picture half a frame off to either side, and from a gain and an offset of the whole.

    Args:
        target: [3, H, W] the picture. shown, ahead, back: the same rendered of Θ_t, and half of a frame on and back.
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
    )  # the change has the gain too


def timings(past: Past) -> dict[str, CameraTiming]:
    """By camera, the moment at which its pictures seem to be taken; only of those of which it is known well enough."""
    looks = {name: CameraTimingSums(*row) for name, row in past.timing.items()}
    known = {name: one for name, one in looks.items() if one.count >= ENOUGH and one.error <= MAX_ERROR}
    if len(known) < CAMERAS:
        return {}
    common = median(one.mean for one in known.values())
    return {name: _timing(one.mean - common, one.error) for name, one in known.items()}


def _timing(frames: float, error: float) -> CameraTiming:
    return {"frames": frames, "error": error, "off": abs(frames) >= max(OFF, SURE * error)}
