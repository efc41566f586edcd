"""Checks of a frame: of its pictures before they are learnt from, and of the state that came of them.

A black frame is finite, and 100 iterations would paint the scene black. Lights flicker, and cameras that choose their
own exposure do it together: learnt as colours, that would be unlearnt a frame later, so the gain is taken out of the
pictures. It is measured against the earlier scene: the median over the pixels is that of the many in which nothing but
the light changed. A light that stays, or that goes on from frame to frame as a lamp that dims, is another one
(``solve_frame``): then the scene's colours take the gain, and its pictures are as they are.

A frame that shows the pictures of the one before comes from a camera at half the rate of its rig, or from a rig that
sends its last frame while it waits. Nothing is learnt from it, and that nothing moved is not believed either: the next
frame is looked for where the motion before them leads.

A state that is not finite, bounded and plausible is never committed. Single Gaussians that are not are held as they
were before; where more than a few are, the whole attempt has failed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import nan
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from scas4d_core.engines.renderer import Renderer
from scas4d_core.engines.views import LABEL, TrainingView
from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.outliers import Past, unless_most
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.view_factory import ViewFactory

Array = NDArray[np.float32]

EXPOSURE = 1.05
"""Times brighter or darker, median over the cameras, from which a frame is exposed otherwise; clean captures: 1.04."""
ALIKE = 1.03
"""Times that the light's step to a frame differs at most from the step before, where it goes on: a lamp that crosses a
room and dims to a half in ten frames: 1.017; of lights that flicker, no step is like the one before."""
ENOUGH = 8
"""Cameras that the exposure needs: an object that turns changes the brightness of one picture by a third."""
UNUSABLE = 2.0
"""Times brighter or darker, as above, from which the light is another and nothing is learnt from the frame."""
BLIND = 0.05
"""Share of its usual brightness, against the other cameras, below which a camera shows nothing."""
DARKEST = 1e-3
"""Mean of a picture, 0…1, below which its brightness says nothing."""

DARK = 0.05
"""Of a channel, 0…1, from which it measures how bright the light is."""
PIXELS = 100
"""Of every other row and column that a camera needs to have a say."""
SATURATED = 0.99
"""Of a channel, 0…1, from which a pixel says only that it is at least so bright."""

EVERY = 4
"""Rows and columns apart of the pixels that fingerprints compare: pictures of a camera are never alike by chance."""


def fingerprints(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, int]:
    """CRC-32 of every fourth pixel of every fourth row of each camera's picture [H, W, 3]."""
    return {name: crc32(picture[::EVERY, ::EVERY].tobytes()) for name, picture in pictures.items()}


def brightness_of(picture: NDArray[np.uint8]) -> float:
    """Mean of every fourth pixel of every fourth row of a picture [H, W, 3], 0…1."""
    return float(picture[::4, ::4].mean()) / 255


def brightness(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, float]:
    """Of each camera's picture."""
    return {name: brightness_of(picture) for name, picture in pictures.items()}


def check_brightness(past: Past, bright: Mapping[str, float]) -> tuple[float, dict[str, str], str | None]:
    """Compare the brightness of a frame's pictures with the usual one, before anything is rendered.

    Args:
        past: of the scene; cameras that were left out before stay so (``outliers.past_after_update``). bright: by
            camera.

    Returns:
        Times that the frame is brighter than usual (1 where it is not seen to differ); the cameras to leave out, with
        the reason; and the reason why nothing can be learnt from the frame, or None.
    """
    left_out = {
        name: "it has not fitted the other cameras since it was left out" for name in bright if past.is_left_out(name)
    }
    usual = {name: past.brightness.get(name, nan) for name in bright}
    ratios = {name: value / usual[name] for name, value in bright.items() if usual[name] > DARKEST}
    if not ratios:
        return 1.0, unless_most(left_out, len(bright)), None
    common = float(np.median(list(ratios.values())))
    enough = len(ratios) >= ENOUGH
    if not 1 / UNUSABLE <= common <= UNUSABLE and (enough or common < BLIND or common > 1 / BLIND):
        return common, left_out, f"the pictures are {common:.2g} times as bright as they were"
    for name, ratio in ratios.items():
        if ratio < BLIND * common:
            left_out[name] = f"it shows nothing: {ratio:.2g} times as bright as it was"
    if not enough or 1 / EXPOSURE <= common <= EXPOSURE:
        common = 1.0
    return common, unless_most(left_out, len(bright)), None


def measure_brightness_ratio(past: Past, bright: Mapping[str, float]) -> float:
    """Brightness over that of the frame before, median over the cameras; 1 where too few pixels are usable."""
    ratios = [
        value / past.last_brightness[name]
        for name, value in bright.items()
        if past.last_brightness.get(name, 0.0) > DARKEST
    ]
    return float(np.median(ratios)) if len(ratios) >= ENOUGH else 1.0


def light_continues(past: Past, bright: Mapping[str, float]) -> bool:
    """True where a frame's light goes on as it went to the frame before, faster than noise explains.

    The scene's own light does so, and is followed at once. A flicker comes back, and a jump has no step before it.
    """
    step = measure_brightness_ratio(past, bright)
    if 1 / EXPOSURE <= step <= EXPOSURE or (step > 1) != (past.brightness_ratio > 1):
        return False
    return 1 / ALIKE <= step / past.brightness_ratio <= ALIKE


def record_brightness(past: Past, bright: Mapping[str, float]) -> Past:
    """The past with how bright the pictures of a frame are, and how much brighter than the frame before."""
    return replace(
        past,
        last_brightness={**past.last_brightness, **bright},
        brightness_ratio=measure_brightness_ratio(past, bright),
    )


def with_light(past: Past, light: float) -> Past:
    """The past with the light of a frame: for how many frames it has been brighter, or darker; darkness is none."""
    if light == 1.0 or not BLIND <= light <= 1 / BLIND:
        return replace(past, light=1.0, light_frames=0)
    same = past.light_frames > 0 and (light > 1) == (past.light > 1)
    return replace(past, light=light, light_frames=past.light_frames + 1 if same else 1)


def compensate_exposure(
    factory: ViewFactory,
    renderer: Renderer,
    state: Gaussians,
    views: Sequence[TrainingView],
    others: Sequence[TrainingView] = (),
) -> tuple[float, list[TrainingView], list[TrainingView]]:
    """Find how many times brighter than usual a frame is, and take that out of its views.

    Args:
        state: Θ_{t−1}, as the frame before shows it. views: of the frame. others: of the frame, without a say.

    Returns:
        1 and the views as they are, where they turn out not to differ.
    """
    shown = [_shown(renderer, state, view) for view in views]
    gain = _gain(views, shown)
    if gain is None or 1 / EXPOSURE <= gain <= EXPOSURE:
        return 1.0, list(views), list(others)
    every = [*views, *others]
    shown += [_shown(renderer, state, view) for view in others]
    without = [factory.retouched(view, _without(view, gain, now)) for view, now in zip(every, shown, strict=True)]
    return gain, without[: len(views)], without[len(views) :]


def measure_light_gain(renderer: Renderer, state: Gaussians, views: Sequence[TrainingView]) -> float | None:
    """Times that a frame is brighter than Θ_{t−1} shows it; None where no camera can say."""
    return _gain(views, [_shown(renderer, state, view) for view in views])


def with_light_gain(state: Gaussians, gain: float) -> Gaussians:
    """The state in a light so many times as bright; colours beyond white are white."""
    colours = state.colours
    return state.replace(colours=np.minimum(np.float32(gain) * colours, np.maximum(colours, np.float32(1))))


def _shown(renderer: Renderer, state: Gaussians, view: TrainingView) -> Array:
    """[3, H, W] the state as the view's camera would show it."""
    planes = renderer.render(state, view.camera).features[:LABEL]
    shown: Array = view.exposure[:LABEL, 0, None, None] * planes + view.exposure[:LABEL, 1, None, None]
    return shown


def _gain(views: Sequence[TrainingView], shown: Sequence[Array]) -> float | None:
    """Median over the cameras that have a say; None where there is none."""
    ratios = [ratio for view, now in zip(views, shown, strict=True) for ratio in _ratio(view.target[:LABEL], now)]
    return float(np.median(ratios)) if ratios else None


def _ratio(picture: Array, shown: Array) -> list[float]:
    """Median over pixels and channels of how much brighter a picture is than what was shown; none of too few."""
    here, there = picture[:, ::2, ::2], shown[:, ::2, ::2]
    says = (there > DARK) & (there < SATURATED) & (here > DARK / 2) & (here < SATURATED)
    return [float(np.median(here[says] / there[says]))] if says.sum() >= 3 * PIXELS else []


def _without(view: TrainingView, gain: float, shown: Array) -> Array:
    """The view's planes over the gain; saturated pixels are taken to be as bright as the scene says, or more."""
    target = view.target.copy()
    saturated = target[:LABEL] >= SATURATED
    target[:LABEL] /= np.float32(gain)
    np.copyto(target[:LABEL], np.maximum(target[:LABEL], shown), where=saturated)
    return target


FARTHEST = 1.0
"""Radii of the rig that a Gaussian may move in one update."""
LONGEST = 1.0
"""Radii of the rig that an axis may become long."""
SHRUNK, STRETCHED = 0.1, 10.0
"""Times its length in frame 0 that an axis may become short or long: thousands of updates add up what each leaves, and
the axes would wander without end (docs/stability.md, Long runs). Such an axis is set to the bound, and counted."""
BRIGHTEST = 8.0
"""Size that a colour may have; 0…1 is what a camera shows, a gain of a camera stretches it."""
FEW = 0.01
"""Share of the moving Gaussians that may be held one by one; more, and the update is not plausible."""


def axis_lengths(gaussians: Gaussians) -> Array:
    """[N, 3] metres."""
    lengths: Array = np.sqrt(np.square(gaussians.factors).sum(axis=1))
    return lengths


def check_plausible(
    before: Gaussians, result: UpdateResult, rows: NDArray[np.int64], radius: float, first: Array | None = None
) -> tuple[UpdateResult, str | None]:
    """Hold what is not finite, bounded and plausible as it was before.

    Args:
        before: Θ_{t−1}. result: of an attempt. rows: [M] the moving. radius: of the rig, metres.
        first: [N, 3] ``axis_lengths`` of frame 0; None: axes may have any length up to ``LONGEST``.

    Returns:
        The result with a state that may be committed, and None; or with ``before``, and the fault of its state.
    """
    after = result.gaussians
    bad = np.zeros(len(after), np.bool_)
    with np.errstate(over="ignore", invalid="ignore"):
        colours = np.abs(after.colours).max(axis=1, initial=0)
        bad |= ~(colours <= BRIGHTEST)  # NaN is not at most anything
        moved = np.square(after.means[rows] - before.means[rows]).sum(axis=1)
        squares = np.square(after.factors[rows]).sum(axis=1)
        lengths = squares.max(axis=1, initial=0)
        turned = np.square(after.rotations[rows]).sum(axis=1)
        fine = (moved <= (FARTHEST * radius) ** 2) & (lengths <= (LONGEST * radius) ** 2) & (np.abs(turned - 1) < 0.01)
        fine &= _oriented(before.factors[rows], after.factors[rows])
    bad[rows] |= ~fine
    count = int(bad.sum())
    if count > max(1, FEW * len(rows)):
        fault = f"{count} of {len(rows)} Gaussians are not finite, or moved or grew too far"
        return replace(result, gaussians=before, frozen=count), fault
    bounded = 0
    if first is not None:
        after, bounded = _bounded(after, rows, squares, first)
    if count:
        arrays = {name: np.where(_like(bad, now), then, now) for name, then, now in _pairs(before, after)}
        after = after.replace(**arrays)
    return replace(result, gaussians=after, frozen=count, bounded=bounded), None


def _bounded(after: Gaussians, rows: NDArray[np.int64], squares: Array, first: Array) -> tuple[Gaussians, int]:
    """Axes set to the bounds of their length, and how many were.

    Args:
        squares: [M, 3] of the axes' lengths. first: [N, 3] lengths in frame 0.
    """
    least, most = np.square(SHRUNK * first[rows]), np.square(STRETCHED * first[rows])
    which, axis = np.nonzero((squares < least) | (squares > most))
    if not len(which):
        return after, 0
    there = squares[which, axis]
    bound = np.where(there < least[which, axis], least[which, axis], most[which, axis])
    factors = after.factors.copy()
    factors[rows[which], :, axis] *= np.sqrt(bound / np.maximum(there, np.finfo(np.float32).tiny))[:, None]
    return after.replace(factors=factors), len(which)


def _oriented(before: NDArray[np.float32], after: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[M] whether the map between two factors [M, 3, 3] has not turned the Gaussian inside out."""
    same: NDArray[np.bool_] = ~(np.sign(_det(before)) * np.sign(_det(after)) < 0)
    return same


def _det(factors: NDArray[np.float32]) -> NDArray[np.float32]:
    """[M] of [M, 3, 3]; scaled by nothing, so a sign is all that is read from it."""
    a, b, c = factors[:, 0], factors[:, 1], factors[:, 2]
    det: NDArray[np.float32] = (a * np.cross(b, c)).sum(axis=1)
    return det


def _pairs(before: Gaussians, after: Gaussians) -> list[tuple[str, NDArray[np.float32], NDArray[np.float32]]]:
    return [
        (name, getattr(before, name), getattr(after, name)) for name in ("means", "factors", "rotations", "colours")
    ]


def _like(rows: NDArray[np.bool_], array: NDArray[np.float32]) -> NDArray[np.bool_]:
    """[N, 1, …] for an array [N, …]."""
    return rows.reshape(-1, *[1] * (array.ndim - 1))
