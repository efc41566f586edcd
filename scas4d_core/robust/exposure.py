"""A frame that is exposed otherwise than those before: its gain is taken out of its pictures, so that colours stay.

Lights flicker, and cameras that choose their own exposure do it together. Learnt as colours, that would be unlearnt a
frame later. How much brighter the pictures are is read against the scene as it stood: the median over the
pixels is that of the many in which nothing but the light changed.

A light that stays is another one (``trial``): then the scene's colours take the gain, and its pictures are as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scas4d_core.gaussians import Gaussians
from scas4d_core.robust.outliers import EXPOSURE
from scas4d_core.update.picture_loss import PictureLoss
from scas4d_core.update.views import LABEL, TrainingView, ViewFactory

Array = NDArray[np.float32]

DARK = 0.05
"""Of a channel, 0…1, from which it tells how bright the light is."""
PIXELS = 100
"""Of every other row and column that a camera needs to have a say."""
SATURATED = 0.99
"""Of a channel, 0…1, from which a pixel says only that it is at least so bright."""


def evened(
    factory: ViewFactory,
    picture: PictureLoss,
    state: Gaussians,
    views: Sequence[TrainingView],
    others: Sequence[TrainingView] = (),
) -> tuple[float, list[TrainingView], list[TrainingView]]:
    """How many times brighter than usual a frame is, and its views as they would be without that.

    Args:
        state: Θ_{t−1}, as the frame before shows it. views: of the frame. others: of the frame, without a say.

    Returns:
        1 and the views as they are, where they turn out not to differ.
    """
    shown = [_shown(picture, state, view) for view in views]
    gain = _gain(views, shown)
    if gain is None or 1 / EXPOSURE <= gain <= EXPOSURE:
        return 1.0, list(views), list(others)
    every = [*views, *others]
    shown += [_shown(picture, state, view) for view in others]
    without = [factory.retouched(view, _without(view, gain, now)) for view, now in zip(every, shown, strict=True)]
    return gain, without[: len(views)], without[len(views) :]


def gain_of(picture: PictureLoss, state: Gaussians, views: Sequence[TrainingView]) -> float | None:
    """How many times brighter a frame is than Θ_{t−1} shows it; None where no camera can say."""
    return _gain(views, [_shown(picture, state, view) for view in views])


def relit(state: Gaussians, gain: float) -> Gaussians:
    """The state in a light so many times as bright; what would be brighter than white is white."""
    colours = state.colours
    return state.replace(colours=np.minimum(np.float32(gain) * colours, np.maximum(colours, np.float32(1))))


def _shown(picture: PictureLoss, state: Gaussians, view: TrainingView) -> Array:
    """[3, H, W] the state as the view's camera would show it."""
    features = np.concatenate([state.colours, state.foreground[:, None]], axis=1)
    picture.measure(state.means, state.factors, state.opacities, features, view)
    planes = picture.rasterizer.planes[:LABEL, : view.camera.height, : view.camera.width]
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
    """The view's planes over the gain; what is saturated is taken to be as bright as the scene says, or more."""
    target = view.target.copy()
    saturated = target[:LABEL] >= SATURATED
    target[:LABEL] /= np.float32(gain)
    np.copyto(target[:LABEL], np.maximum(target[:LABEL], shown), where=saturated)
    return target
