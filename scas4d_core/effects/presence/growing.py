"""Grows Gaussians on the hull of what is new, and fits them alone to the pictures; all others stand still.

Only the part of each picture that shows the hull is rendered, with the Gaussians that reach into it: an iteration costs
a small share of one of the update.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scas4d_core.effects.presence.carving import Hull, colours_of

if TYPE_CHECKING:
    from scas4d_core.cameras import Camera, Rig
    from scas4d_core.effects.evidence import FitTime
    from scas4d_core.effects.presence.novelty import Novelty
    from scas4d_core.engines.cpu.renderer import CpuRenderer
    from scas4d_core.engines.views import TrainingView
    from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]
Float = NDArray[np.float64]
Int = NDArray[np.int64]

ITERATIONS = 400
"""Of a fit: on the part of the pictures that shows the thing they take less time than an update of 100."""
SETTLING = 150
"""Of the fit of what was born some frames ago, after each update."""
FEWEST = 0.25
"""Share of the iterations of a fit, of which there must be time for more: what is half fitted is in every frame after,
and the next frame finds it as well."""
SHORTEST = 1e-6
"""Metres, of an axis."""
OPACITY = 0.6
"""Of a Gaussian when it is born: on a surface that is known, more than the 0.1 of a cloud of which half is wrong."""
CONFIRMED = 2
"""Cameras that must see the colour of a point."""
MARGIN = 8
"""Pixels about what is rendered: the window of SSIM, and the Gaussians' widths."""
WIDTHS = 3.5
"""Standard deviations that a Gaussian reaches."""
POSITION, COLOUR, LOGIT, SCALE, ROTATION = 3.2e-4, 1e-2, 5e-2, 1e-2, 4e-3
"""Adam's rates of means (per metre of the rig's radius), RGB, logits of opacity, log scales, quaternions: one to four
times those of frame 0, for an eighth of its iterations."""
END = 0.05
"""Of the rates that is left at the end, along half a cosine."""
BETA1, BETA2 = np.float32(0.8), np.float32(0.95)
"""Of Adam: those of the update, whose iterations are as few."""


def seeds(seen: Sequence[Novelty], hull: Hull, limit: int, rng: np.random.Generator) -> tuple[Float, Array]:
    """Points [P, 3] on the hull's surface with their colours [P, 3]; at most ``limit``, drawn at random."""
    points = hull.points[hull.surface]
    colours, count = colours_of(seen, points, hull)
    fine = np.flatnonzero(count >= CONFIRMED)
    if len(fine) > limit:
        fine = np.sort(rng.choice(fine, limit, replace=False))
    return points[fine], colours[fine]


def grown(
    state: Gaussians,
    points: Float,
    colours: Array,
    views: Sequence[TrainingView],
    rig: Rig,
    picture: CpuRenderer,
    rng: np.random.Generator,
    *,
    moves: bool,
    time: FitTime,
) -> Gaussians | None:
    """Gaussians on points, fitted to the views beside those of the state; None where there is no time for it.

    Args:
        state: Θ_t, all of whose Gaussians stay as they are. points: [P, 3] inside. colours: [P, 3].
        views: of the frame. rig: the cameras inside. picture: has background and limits of the scene.
        rng: of the order of views. moves: whether they do, or stand. time: for the fit.
    """
    from scas4d_core.first_frame import initial_gaussians as made

    parameters = made.initial_parameters(points, colours, None, len(points), rng)
    parameters[:, made.OPACITY] = made.logit(np.array(OPACITY))
    parameters[:, made.LABEL] = made.logit(np.array(float(moves)))
    fit = _Fit(state, parameters, views, rig, picture)
    if not fit.run(ITERATIONS, rng, time):
        time.put_off.append(f"{len(points)} Gaussians that {'move' if moves else 'stand'} were not born")
        return None
    return fit.gaussians()


def settled(
    state: Gaussians,
    rows: Int,
    views: Sequence[TrainingView],
    rig: Rig,
    picture: CpuRenderer,
    rng: np.random.Generator,
    time: FitTime,
) -> Gaussians:
    """The state with means, factors and colours of some rows fitted to the views; opacities stay for ever.

    Args:
        rows: of young Gaussians: their hull was rough, and their first update as well. What is glossy, and came back as
            itself, is left as it is: more is seen of it than its colours, which alone are fitted.
        time: for the fit; without enough of it they stay as they are.
    """
    from scas4d_core.first_frame import initial_gaussians as made

    if state.gloss is not None:  # those born later have none
        rows = rows[rows >= len(state.gloss)]
    if not len(rows):
        return state
    mine, others = state.rows(rows), state.retire(rows)
    sides, lengths, axes = np.linalg.svd(mine.factors.astype(np.float64))
    handed = np.sign(np.linalg.det(sides))
    sides[:, :, 2] *= handed[:, None]
    axes[:, 2] *= handed[:, None]
    parameters = np.zeros((len(rows), 15), np.float32)
    parameters[:, made.MEAN] = mine.means
    parameters[:, made.QUATERNION] = Rotation.from_matrix(sides).as_quat()[:, [3, 0, 1, 2]]
    parameters[:, made.SCALE] = np.log(np.maximum(lengths, SHORTEST))
    parameters[:, made.OPACITY] = made.logit(mine.opacities[:, None])
    parameters[:, made.COLOUR] = mine.colours
    parameters[:, made.LABEL] = made.logit(mine.foreground[:, None])
    fit = _Fit(others, parameters, views, rig, picture)
    if not fit.run(SETTLING, rng, time, opacities=False):
        time.put_off.append(f"{len(rows)} young Gaussians were not settled")
        return state
    found = fit.gaussians()
    means, factors, colours = state.means.copy(), state.factors.copy(), state.colours.copy()
    means[rows], colours[rows] = found.means, found.colours
    factors[rows] = found.factors @ axes.astype(np.float32)  # the axes that were transported stay the same ones
    return state.replace(means=means, factors=factors, colours=colours)


class _Crop(NamedTuple):
    """The part of a view that is rendered, the others that reach into it, and the arrays that hold them all."""

    view: TrainingView
    others: int
    means: Array
    factors: Array
    opacities: Array
    features: Array

    @property
    def born(self) -> tuple[Array, Array, Array, Array]:
        n = self.others
        return self.means[n:], self.factors[n:], self.opacities[n:], self.features[n:]


class _Fit:
    """Fits the rows of a table of parameters (``kernels.activation``) beside a state that stays as it is."""

    def __init__(
        self, state: Gaussians, parameters: Array, views: Sequence[TrainingView], rig: Rig, picture: CpuRenderer
    ) -> None:
        from scas4d_core.update.view_factory import ViewFactory

        self._parameters, self._radius = parameters, rig.radius
        factory = ViewFactory(rig)
        self._picture = picture.apart()
        self._crops = []
        for view in views:
            box = _box(rig[view.name], parameters[:, :3].astype(np.float64))
            if box is not None:
                rows = _reaching(state, rig[view.name], box)
                self._crops.append(self._crop(state, rows, factory.cropped(view, *box)))

    def _crop(self, state: Gaussians, rows: Int, view: TrainingView) -> _Crop:
        from scas4d_core.engines.cpu.gloss import features_seen  # it loads the kernels

        n = len(rows)
        count = n + len(self._parameters)
        made = _Crop(
            view, n, np.empty((count, 3), np.float32), np.empty((count, 3, 3), np.float32),
            np.empty(count, np.float32), np.empty((count, 4), np.float32),
        )  # fmt: skip
        made.means[:n], made.factors[:n] = state.means[rows], state.factors[rows]
        made.opacities[:n] = state.opacities[rows]
        made.features[:n] = features_seen(state.rows(rows), view.camera)
        return made

    def run(self, iterations: int, rng: np.random.Generator, time: FitTime, opacities: bool = True) -> bool:
        """Steps the parameters so many times, each with a part of one view, or as often as there is time for.

        Args:
            opacities: whether these change.

        Returns:
            False where there is time for too few steps: what was fitted so far is of no use.
        """
        began = perf_counter()
        whole = self._stepped(iterations, rng, time.end, opacities)
        time.spent += perf_counter() - began
        return whole

    def _stepped(self, iterations: int, rng: np.random.Generator, end: float | None, opacities: bool) -> bool:
        from scas4d_core.first_frame import initial_gaussians as columns
        from scas4d_core.kernels import activation
        from scas4d_core.kernels.adam import EVERY_ROW, adam
        from scas4d_core.update.schedule import PROBE, Stopping, view_order

        if not self._crops or not len(self._parameters):
            return True
        if end is not None and perf_counter() >= end:
            return False
        stopping = Stopping(iterations, end=end)
        parameters = self._parameters
        gradients, first, second = (np.zeros_like(parameters) for _ in range(3))
        rates = np.zeros(activation.COLUMNS, np.float32)
        rates[columns.MEAN], rates[columns.COLOUR] = POSITION * self._radius, COLOUR
        rates[columns.OPACITY], rates[columns.SCALE], rates[columns.QUATERNION] = LOGIT * opacities, SCALE, ROTATION
        for iteration, index in enumerate(view_order(len(self._crops), iterations, rng)):
            planned = stopping.planned(iteration)
            if iteration >= min(PROBE, planned) and planned < FEWEST * iterations:
                return False
            if iteration >= planned:
                break
            crop = self._crops[index]
            n, born = crop.others, crop.born
            activation.activate(parameters, *born)
            found = self._picture.evaluate(crop.means, crop.factors, crop.opacities, crop.features, crop.view)
            activation.activate_backward(
                parameters, *born[1:], found.means[n:], found.factors[n:], found.opacities[n:], found.features[n:],
                gradients,
            )  # fmt: skip
            left = END + (1 - END) * 0.5 * (1 + np.cos(np.pi * min(1.0, iteration / max(1, planned - 1))))
            adam(
                parameters, gradients, first, second, (left * rates).astype(np.float32), EVERY_ROW, BETA1, BETA2,
                iteration + 1,
            )  # fmt: skip
        return True

    def gaussians(self) -> Gaussians:
        """The fitted Gaussians."""
        from scas4d_core.gaussians import Gaussians
        from scas4d_core.kernels import activation

        count = len(self._parameters)
        made = Gaussians.of_points(self._parameters[:, :3], 0.0)
        features = np.empty((count, 4), np.float32)
        activation.activate(self._parameters, made.means, made.factors, made.opacities, features)
        return made.replace(colours=features[:, :3].copy(), foreground=np.round(features[:, 3]))


def _box(camera: Camera, points: Float) -> tuple[int, int, int, int] | None:
    """Left, top, right, bottom of the pixels that show points [P, 3] and a margin; None where hardly any do."""
    uv, depth = camera.project(points)
    if not (depth > 0).all():
        return None
    left, top = np.maximum(np.floor(uv.min(axis=0)).astype(int) - MARGIN, 0).tolist()
    right, bottom = np.minimum(np.ceil(uv.max(axis=0)).astype(int) + MARGIN, [camera.width, camera.height]).tolist()
    return None if min(right - left, bottom - top) < 2 * MARGIN else (left, top, right, bottom)


def _reaching(state: Gaussians, camera: Camera, box: tuple[int, int, int, int]) -> Int:
    """Rows of the Gaussians that may reach into a part of a picture."""
    uv, depth = camera.project(state.means.astype(np.float64))
    width = np.sqrt(np.square(state.factors).sum(axis=(1, 2)))
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (WIDTHS * camera.fx * width / depth + 2)[:, None]
        inside = (uv > np.array(box[:2]) - reach) & (uv < np.array(box[2:]) + reach)
    return np.flatnonzero((depth > 0) & inside.all(axis=1))
