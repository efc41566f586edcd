"""Creates Gaussians on the hull of new objects, and fits only these Gaussians to the images.

Only the part of each image that shows the hull is rendered, with the Gaussians that reach into it. An iteration
therefore costs a small fraction of an update iteration.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scas4d_core.effects.presence.carving import Hull, colours_of
from scas4d_core.engines.choose import fit_engine_of
from scas4d_core.engines.fit import COLOUR, COLUMNS, LABEL, MEAN, OPACITY, QUATERNION, SCALE, FitScalars
from scas4d_core.fit.gaussian_fit import FitStep, GaussianFit, each_once
from scas4d_core.fit.initial_gaussians import initial_parameters, logit
from scas4d_core.update import schedule
from scas4d_core.update.view_factory import ViewFactory

if TYPE_CHECKING:
    from scas4d_core.cameras import Camera, Rig
    from scas4d_core.effects.evidence import FitTime
    from scas4d_core.effects.presence.novelty import Novelty
    from scas4d_core.engines.renderer import Renderer
    from scas4d_core.engines.views import TrainingView
    from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]
Float = NDArray[np.float64]
Int = NDArray[np.int64]

ITERATIONS = 400
"""Number of iterations of a fit. On image crops, they take less time than an update of 100 iterations."""
SETTLING = 150
"""Number of iterations for refining recently added Gaussians after each update."""
FEWEST = 0.25
"""Minimum share of a fit's iterations for which there must be enough time. Half-fitted Gaussians would harm all later
frames, and the next frame detects the object again anyway."""
SHORTEST = 1e-6
"""Minimum length of an axis, in metres."""
FIRST_OPACITY = 0.6
"""Initial opacity of an added Gaussian. Its surface is known, so the value is higher than the 0.1 used for the
unreliable initial point cloud.
"""
CONFIRMED = 2
"""Minimum number of cameras that must see the colour of a point."""
MARGIN = 8
"""Margin around the rendered region, in pixels, for the SSIM window and the extent of the Gaussians."""
WIDTHS = 3.5
"""Extent of a Gaussian, in standard deviations."""
RATE_POSITION, RATE_COLOUR, RATE_OPACITY, RATE_SCALE, RATE_ROTATION = 3.2e-4, 1e-2, 5e-2, 1e-2, 4e-3
"""Adam learning rates of means (per metre of the rig's radius), RGB, opacity logits, log scales and quaternions. They
are one to four times those of frame 0, which has eight times as many iterations."""
END = 0.05
"""Fraction to which the learning rates decay on a half-cosine by the end of a fit."""
BETA1, BETA2 = np.float32(0.8), np.float32(0.95)
"""Decay rates of Adam, as in the update, which has similarly few iterations."""


def sample_seeds(seen: Sequence[Novelty], hull: Hull, limit: int, rng: np.random.Generator) -> tuple[Float, Array]:
    """Returns at most ``limit`` random points [P, 3] on the hull's surface, with their colours [P, 3]."""
    points = hull.points[hull.surface]
    colours, count = colours_of(seen, points, hull)
    fine = np.flatnonzero(count >= CONFIRMED)
    if len(fine) > limit:
        fine = np.sort(rng.choice(fine, limit, replace=False))
    return points[fine], colours[fine]


def fit_newborns(
    state: Gaussians,
    points: Float,
    colours: Array,
    views: Sequence[TrainingView],
    rig: Rig,
    renderer: Renderer,
    rng: np.random.Generator,
    *,
    moves: bool,
    time: FitTime,
) -> Gaussians | None:
    """Returns new Gaussians at the given points, fitted to the views with a fixed state, or None if time is too short.

    Args:
        state: state Θ_t; its Gaussians are not changed.
        points: [P, 3] initial means in the internal world.
        colours: [P, 3] initial RGB.
        views: training views of the frame.
        rig: cameras in the internal world.
        renderer: renderer with the background and limits of the scene.
        rng: random generator for the order of views.
        moves: whether the new Gaussians are labelled as moving.
        time: time limit of the fit.
    """
    parameters = initial_parameters(points, colours, None, len(points), rng)
    parameters[:, OPACITY] = logit(np.array(FIRST_OPACITY))
    parameters[:, LABEL] = logit(np.array(float(moves)))
    born = _fit_crops(state, parameters, views, rig, renderer, rng, time, iterations=ITERATIONS)
    if born is None:
        time.postponed.append(f"{len(points)} {'moving' if moves else 'static'} Gaussians were not added")
    return born


def refine_newborns(
    state: Gaussians,
    rows: Int,
    views: Sequence[TrainingView],
    rig: Rig,
    renderer: Renderer,
    rng: np.random.Generator,
    time: FitTime,
) -> Gaussians:
    """Returns the state with the means, factors and colours of some rows fitted to the views. Opacities are fixed.

    Args:
        state: state Θ_t.
        rows: rows of recently added Gaussians, whose hull and first update were coarse. Revived glossy Gaussians are
            skipped, because the fit does not model gloss.
        views: training views of the frame.
        rig: cameras in the internal world.
        renderer: renderer with the background and limits of the scene.
        rng: random generator for the order of views.
        time: time limit of the fit; the state is unchanged if there is too little time.
    """
    if state.gloss is not None:  # Gaussians added later have no gloss
        rows = rows[rows >= len(state.gloss)]
    if not len(rows):
        return state
    mine, others = state.rows(rows), state.retire(rows)
    sides, lengths, axes = np.linalg.svd(mine.factors.astype(np.float64))
    handed = np.sign(np.linalg.det(sides))
    sides[:, :, 2] *= handed[:, None]
    axes[:, 2] *= handed[:, None]
    parameters = np.zeros((len(rows), COLUMNS), np.float32)
    parameters[:, MEAN] = mine.means
    parameters[:, QUATERNION] = Rotation.from_matrix(sides).as_quat()[:, [3, 0, 1, 2]]
    parameters[:, SCALE] = np.log(np.maximum(lengths, SHORTEST))
    parameters[:, OPACITY] = logit(mine.opacities[:, None])
    parameters[:, COLOUR] = mine.colours
    parameters[:, LABEL] = logit(mine.foreground[:, None])
    given = views, rig, renderer, rng, time
    fitted = _fit_crops(others, parameters, *given, iterations=SETTLING, opacities=False)
    if fitted is None:
        time.postponed.append(f"{len(rows)} recently added Gaussians were not refined")
        return state
    means, factors, colours = state.means.copy(), state.factors.copy(), state.colours.copy()
    means[rows], colours[rows] = fitted.means, fitted.colours
    factors[rows] = fitted.factors @ axes.astype(np.float32)  # keeps the correspondence of the transported axes
    return state.replace(means=means, factors=factors, colours=colours)


class _Schedule:
    """Schedule of a fit, which runs the planned number of iterations, or as many as time allows.

    The learning rates follow a half-cosine.

    Args:
        iterations: planned number of iterations.
        end: ``perf_counter`` value at which the fit must end, or None for no limit.
        rates: initial learning rate of each column of the parameters.

    Attributes:
        whole: whether there was time for enough iterations; otherwise, the result is discarded.
    """

    def __init__(self, iterations: int, end: float | None, rates: Array) -> None:
        self._iterations, self._end, self._rates = iterations, end, rates
        self._stopping, self._planned = schedule.Stopping(iterations, end=end), iterations
        self.whole = True

    def begin(self, done: int) -> FitStep | None:
        """Returns the step of the next iteration, or None to end the fit; see ``GaussianFit.run``."""
        if done == 0 and self._end is not None and perf_counter() >= self._end:
            self.whole = False
            return None
        self._planned = self._stopping.planned(done)
        probed = done >= min(schedule.PROBE, self._planned)
        self.whole = not probed or self._planned >= FEWEST * self._iterations
        return each_once(done) if self.whole and done < self._planned else None

    def scalars(self, now: FitStep) -> FitScalars:
        """Returns the scalars of an iteration; see ``GaussianFit.run``."""
        left = END + (1 - END) * 0.5 * (1 + np.cos(np.pi * min(1.0, now.begun / max(1, self._planned - 1))))
        return FitScalars((left * self._rates).astype(np.float32))


def _fit_crops(
    state: Gaussians,
    parameters: Array,
    views: Sequence[TrainingView],
    rig: Rig,
    renderer: Renderer,
    rng: np.random.Generator,
    time: FitTime,
    *,
    iterations: int,
    opacities: bool = True,
) -> Gaussians | None:
    """Returns Gaussians fitted next to a fixed state, or None if time is too short.

    Each step uses a crop of one view. Opacities are fitted only if ``opacities`` is true.
    """
    fit = _beside(state, parameters, views, rig, renderer)
    rates = np.zeros(COLUMNS, np.float32)
    rates[MEAN], rates[COLOUR] = RATE_POSITION * rig.radius, RATE_COLOUR
    rates[OPACITY], rates[SCALE], rates[QUATERNION] = RATE_OPACITY * opacities, RATE_SCALE, RATE_ROTATION
    steps, began = _Schedule(iterations, time.end, rates), perf_counter()
    if fit.views and len(fit):
        order = schedule.view_order(len(fit.views), iterations, rng)
        fit.run(order, steps.scalars, steps.begin)
    time.spent += perf_counter() - began
    if not steps.whole:
        return None
    fitted = fit.state()
    return fitted.replace(foreground=np.round(fitted.foreground))


def _beside(
    state: Gaussians, parameters: Array, views: Sequence[TrainingView], rig: Rig, renderer: Renderer
) -> GaussianFit:
    """Returns a fit on crops around the new Gaussians, with the state's Gaussians that reach into the crops."""
    factory, crops, fixed = ViewFactory(rig), [], []
    for view in views:
        camera = rig[view.name]
        box = _box(camera, parameters[:, MEAN].astype(np.float64))
        if box is not None:
            fixed.append(state.rows(_reaching(state, camera, box)))
            crops.append(factory.cropped(view, *box))
    return GaussianFit(fit_engine_of(renderer), crops, parameters, fixed=fixed, betas=(BETA1, BETA2))


def _box(camera: Camera, points: Float) -> tuple[int, int, int, int] | None:
    """Returns (left, top, right, bottom) of a box around points [P, 3] in an image, with a margin.

    Returns None if the box is too small or a point is behind the camera.
    """
    uv, depth = camera.project(points)
    if not (depth > 0).all():
        return None
    left, top = np.maximum(np.floor(uv.min(axis=0)).astype(int) - MARGIN, 0).tolist()
    right, bottom = np.minimum(np.ceil(uv.max(axis=0)).astype(int) + MARGIN, [camera.width, camera.height]).tolist()
    return None if min(right - left, bottom - top) < 2 * MARGIN else (left, top, right, bottom)


def _reaching(state: Gaussians, camera: Camera, box: tuple[int, int, int, int]) -> Int:
    """Returns the rows of the Gaussians that may reach into a box (left, top, right, bottom) of an image."""
    uv, depth = camera.project(state.means.astype(np.float64))
    width = np.sqrt(np.square(state.factors).sum(axis=(1, 2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (WIDTHS * camera.fx * width / depth + 2)[:, None]
        inside = (uv > np.array(box[:2]) - reach) & (uv < np.array(box[2:]) + reach)
    return np.flatnonzero((depth > 0) & inside.all(axis=1))
