"""Checks of a frame's images before they are used, and of the resulting state.

A black frame contains no invalid values, but 100 iterations on it would turn the scene black. Lights flicker, and
auto-exposure changes all cameras together. If such a change were learnt as colours, it would have to be unlearnt in the
next frame. Its gain is therefore removed from the images. The gain is measured relative to the previous state, as the
median over pixels, because in most pixels only the lighting has changed. A lighting change may also persist, or
continue from frame to frame, as when a lamp dims. ``solve_frame`` then scales the scene's colours by the gain and
leaves the images unchanged.

A frame may repeat the images of the previous frame, because a camera runs at half the rate of its rig or an idle rig
resends its last frame. Nothing is learnt from such a frame. Repeated images do not count as a pause in the motion,
so the next frame starts from the motion before them.

A state that is not finite, bounded and plausible is never committed. Single faulty Gaussians keep their previous state.
With more than a few faulty Gaussians, the whole attempt fails.
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
from scas4d_core.kernels.states import find_implausible
from scas4d_core.robust.outliers import Past, unless_most
from scas4d_core.update.result import UpdateResult
from scas4d_core.update.view_factory import ViewFactory

Array = NDArray[np.float32]

EXPOSURE = 1.05
"""Median brightness ratio over cameras above which the exposure of a frame counts as different. Clean captures reach
1.04."""
ALIKE = 1.03
"""Maximum ratio between consecutive brightness steps of a light that changes continuously. A lamp that crosses a room
and dims to half its brightness in ten frames has a ratio of 1.017. The steps of flickering lights are not similar."""
ENOUGH = 8
"""Minimum number of cameras for estimating exposure. A turning object can change the brightness of one image by a
third."""
UNUSABLE = 2.0
"""Brightness ratio above which the lighting is too different to learn from the frame."""
BLIND = 0.05
"""Share of a camera's usual brightness, relative to the other cameras, below which its image is dark."""
DARKEST = 1e-3
"""Mean of an image, [0, 1], below which its brightness is not meaningful."""

DARK = 0.05
"""Channel value, [0, 1], above which a pixel is used for measuring the brightness."""
PIXELS = 100
"""Minimum number of usable pixels of a camera, on a grid of every other row and column."""
SATURATED = 0.99
"""Channel value, [0, 1], at which a pixel is saturated and only provides a lower bound on the brightness."""

EVERY = 4
"""Row and column stride of the pixels in a fingerprint. Two images of a camera are never identical by chance."""


def fingerprints(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, int]:
    """Returns the CRC-32 of every fourth pixel of every fourth row of each camera's image [H, W, 3]."""
    return {name: crc32(_sample(picture).data) for name, picture in pictures.items()}


def brightness_of(picture: NDArray[np.uint8]) -> float:
    """Returns the mean of every fourth pixel of every fourth row of an image [H, W, 3], [0, 1]."""
    return float(_sample(picture).mean()) / 255


def _sample(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.ascontiguousarray(picture[::EVERY, ::EVERY])


def brightness(pictures: Mapping[str, NDArray[np.uint8]]) -> dict[str, float]:
    """Returns ``brightness_of`` each camera's image, keyed by camera name."""
    return {name: brightness_of(picture) for name, picture in pictures.items()}


def check_brightness(past: Past, bright: Mapping[str, float]) -> tuple[float, dict[str, str], str | None]:
    """Compares the brightness of a frame's images with their usual brightness, before anything is rendered.

    Args:
        past: usual values of the scene. Excluded cameras stay excluded (``outliers.past_after_update``).
        bright: brightness of each camera's image.

    Returns:
        The brightness ratio of the frame, or 1 if it is within the usual range; the cameras to exclude, with the
        reasons; and the reason why nothing can be learnt from the frame, or None.
    """
    left_out = {
        name: f"excluded until its images fit again; frames so far: {past.frames_left_out[name]}"
        for name in bright
        if past.is_left_out(name)
    }
    usual = {name: past.brightness.get(name, nan) for name in bright}
    ratios = {name: value / usual[name] for name, value in bright.items() if usual[name] > DARKEST}
    if not ratios:
        return 1.0, unless_most(left_out, len(bright)), None
    common = float(np.median(list(ratios.values())))
    enough = len(ratios) >= ENOUGH
    if not 1 / UNUSABLE <= common <= UNUSABLE and (enough or common < BLIND or common > 1 / BLIND):
        return common, left_out, f"the images are {common:.2g} times as bright as before"
    for name, ratio in ratios.items():
        if ratio < BLIND * common:
            left_out[name] = f"its image is dark: {ratio:.2g} times as bright as before"
    if not enough or 1 / EXPOSURE <= common <= EXPOSURE:
        common = 1.0
    return common, unless_most(left_out, len(bright)), None


def measure_brightness_ratio(past: Past, bright: Mapping[str, float]) -> float:
    """Returns the median ratio of the images' brightness to the last frame's, or 1 if too few cameras are usable."""
    ratios = [
        value / past.last_brightness[name]
        for name, value in bright.items()
        if past.last_brightness.get(name, 0.0) > DARKEST
    ]
    return float(np.median(ratios)) if len(ratios) >= ENOUGH else 1.0


def light_continues(past: Past, bright: Mapping[str, float]) -> bool:
    """Returns whether a lighting change continues at the same rate as in the previous frame and exceeds noise.

    In this case, the scene's own lighting is changing, and the colours are adapted immediately. Flicker reverses, and a
    sudden jump has no previous step.
    """
    step = measure_brightness_ratio(past, bright)
    if 1 / EXPOSURE <= step <= EXPOSURE or (step > 1) != (past.brightness_ratio > 1):
        return False
    return 1 / ALIKE <= step / past.brightness_ratio <= ALIKE


def record_brightness(past: Past, bright: Mapping[str, float]) -> Past:
    """Returns the past with the brightness of a frame's images and its ratio to the previous frame."""
    return replace(
        past,
        last_brightness={**past.last_brightness, **bright},
        brightness_ratio=measure_brightness_ratio(past, bright),
    )


def with_light(past: Past, light: float) -> Past:
    """Returns the past with a frame's brightness ratio and the number of consecutive brighter or darker frames."""
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
    """Estimates how much brighter than usual a frame is, and removes this gain from its views.

    Args:
        factory: factory that creates the new views.
        renderer: renderer for the state.
        state: previous state Θ_{t−1}.
        views: views of the frame.
        others: further views, which are not used for the estimate.

    Returns:
        The gain, and both lists of views with the gain removed; 1 and the unchanged views if the gain is within the
        usual range.
    """
    shown = _shown(renderer, state, views)
    gain = _gain(views, shown)
    if gain is None or 1 / EXPOSURE <= gain <= EXPOSURE:
        return 1.0, list(views), list(others)
    every = [*views, *others]
    shown += _shown(renderer, state, others)
    without = [factory.retouched(view, _without(view, gain, now)) for view, now in zip(every, shown, strict=True)]
    return gain, without[: len(views)], without[len(views) :]


def measure_light_gain(renderer: Renderer, state: Gaussians, views: Sequence[TrainingView]) -> float | None:
    """Returns the brightness of a frame relative to renderings of Θ_{t−1}, or None if no camera is usable."""
    return _gain(views, _shown(renderer, state, views))


def with_light_gain(state: Gaussians, gain: float) -> Gaussians:
    """Returns the state with its colours scaled by ``gain``, but not raised above white."""
    colours = state.colours
    return state.replace(colours=np.minimum(np.float32(gain) * colours, np.maximum(colours, np.float32(1))))


def _shown(renderer: Renderer, state: Gaussians, views: Sequence[TrainingView]) -> list[Array]:
    """Returns the [3, H, W] rendering of the state in each view, with the camera's exposure."""
    pictures = renderer.render_each([(state, view.camera) for view in views])
    return [view.exposed(picture.features[:LABEL]) for view, picture in zip(views, pictures, strict=True)]


def _gain(views: Sequence[TrainingView], shown: Sequence[Array]) -> float | None:
    """Returns the median brightness ratio of views to renderings over usable cameras, or None if there are none."""
    ratios = [ratio for view, now in zip(views, shown, strict=True) for ratio in _ratio(view.target[:LABEL], now)]
    return float(np.median(ratios)) if ratios else None


def _ratio(picture: Array, shown: Array) -> list[float]:
    """Returns the median brightness ratio over pixels and channels as a list, empty if there are too few pixels."""
    here, there = picture[:, ::2, ::2], shown[:, ::2, ::2]
    says = (there > DARK) & (there < SATURATED) & (here > DARK / 2) & (here < SATURATED)
    return [float(np.median(here[says] / there[says]))] if says.sum() >= 3 * PIXELS else []


def _without(view: TrainingView, gain: float, shown: Array) -> Array:
    """Returns the view's image divided by the gain, with saturated pixels at least as bright as the rendering."""
    target = view.target.copy()
    saturated = target[:LABEL] >= SATURATED
    target[:LABEL] /= np.float32(gain)
    np.copyto(target[:LABEL], np.maximum(target[:LABEL], shown), where=saturated)
    return target


FARTHEST = 1.0
"""Maximum displacement of a Gaussian in one update, in rig radii."""
LONGEST = 1.0
"""Maximum length of an axis, in rig radii."""
SHRUNK, STRETCHED = 0.1, 10.0
"""Bounds of an axis length relative to its length in frame 0. Over thousands of updates, small residuals add up and
lengths would drift without limit (docs/stability.md, Long runs). An axis outside the bounds is clamped and counted."""
BRIGHTEST = 8.0
"""Maximum absolute value of a colour. Cameras record [0, 1], and camera gains extend this range."""
FEW = 0.01
"""Maximum share of moving Gaussians that keep their previous state. With more, the update is implausible."""


def axis_lengths(gaussians: Gaussians) -> Array:
    """Returns the [N, 3] axis lengths of Gaussians, in metres."""
    lengths: Array = np.sqrt(np.square(gaussians.factors).sum(axis=1))
    return lengths


def check_plausible(
    before: Gaussians, result: UpdateResult, rows: NDArray[np.int64], radius: float, first: Array | None = None
) -> tuple[UpdateResult, str | None]:
    """Restores the previous state of Gaussians whose new state is not finite, bounded and plausible.

    Args:
        before: previous state Θ_{t−1}.
        result: result of an attempt.
        rows: [M] rows of the moving Gaussians.
        radius: radius of the rig, in metres.
        first: [N, 3] ``axis_lengths`` of frame 0, or None to limit axes only by ``LONGEST``.

    Returns:
        The result with a state that may be committed, and None. If the whole state is implausible, the result with the
        state ``before``, and the reason.
    """
    after = result.gaussians
    bad, squares = np.empty(len(after), np.bool_), np.empty((len(rows), 3), np.float32)
    limits = (np.float32(limit) for limit in ((FARTHEST * radius) ** 2, (LONGEST * radius) ** 2, BRIGHTEST))
    find_implausible(
        before.means, before.factors, after.means, after.factors, after.rotations, after.colours, rows, *limits,
        bad, squares,
    )  # fmt: skip
    count = int(bad.sum())
    if count > max(1, FEW * len(rows)):
        fault = f"{count} of {len(rows)} Gaussians have non-finite values, or moved or grew too much"
        return replace(result, gaussians=before, frozen=count), fault
    bounded = 0
    if first is not None:
        after, bounded = _bounded(after, rows, squares, first)
    if count:
        arrays = {name: np.where(_like(bad, now), then, now) for name, then, now in _pairs(before, after)}
        after = after.replace(**arrays)
    return replace(result, gaussians=after, frozen=count, bounded=bounded), None


def _bounded(after: Gaussians, rows: NDArray[np.int64], squares: Array, first: Array) -> tuple[Gaussians, int]:
    """Returns the state with the axis lengths clamped to their bounds, and the number of clamped axes.

    Args:
        after: state to clamp.
        rows: [M] rows of the moving Gaussians.
        squares: [M, 3] squared axis lengths.
        first: [N, 3] axis lengths in frame 0.
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


def _pairs(before: Gaussians, after: Gaussians) -> list[tuple[str, NDArray[np.float32], NDArray[np.float32]]]:
    return [
        (name, getattr(before, name), getattr(after, name)) for name in ("means", "factors", "rotations", "colours")
    ]


def _like(rows: NDArray[np.bool_], array: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Returns the mask of rows [N], reshaped to [N, 1, …] to match an array [N, …]."""
    return rows.reshape(-1, *[1] * (array.ndim - 1))
