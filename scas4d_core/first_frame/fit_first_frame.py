"""Fit of frame 0, and the data from frame 0 that every update needs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.engines.choose import resolve_device
from scas4d_core.first_frame.fit_schedule import REPORTED_SHORTFALL, FitProgress
from scas4d_core.first_frame.glossy import fit_with_gloss_trial
from scas4d_core.first_frame.initial_points import initial_points
from scas4d_core.first_frame.points.silhouettes import PIXEL_STRIDE, backdrop, mean_colour
from scas4d_core.first_frame.points.stereo import load_stereo
from scas4d_core.first_frame.static_result import FirstCloud, StaticResult
from scas4d_core.first_frame.static_scene import first_trainer
from scas4d_core.first_frame.time_limit import TimeLimit
from scas4d_core.progress import Progress
from scas4d_core.robust.checks import axis_lengths
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History, HistoryError
from scas4d_core.update.view_factory import ViewFactory

Colour = tuple[float, float, float]


def with_background(settings: Settings, images: Mapping[str, NDArray[np.uint8]]) -> Settings:
    """Returns the settings with the background 'auto' replaced by a colour from the images.

    If the images show a plain backdrop, the background gets its colour. Otherwise, the background
    gets the mean colour of the images. A background colour that does not occur in the images, such
    as black in a bright room, would cause dark seams, and black holes in regions that no camera
    sees.

    Args:
        settings: settings of the scene.
        images: images of frame 0, keyed by camera name.

    >>> from scas4d_core.settings import Settings
    >>> green = np.full((64, 64, 3), (20, 200, 30), np.uint8)
    >>> with_background(Settings(), {"front": green}).scene.background
    (0.0784, 0.7843, 0.1176)
    """
    if settings.scene.background != "auto":
        return settings
    pictures = [image for image in images.values() if image.ndim == 3 and image.shape[2] == 3]
    pictures = [image for image in pictures if min(image.shape[:2]) > PIXEL_STRIDE]
    if not pictures:  # such images are rejected later with an error message
        return settings
    backdrop_colour = backdrop(pictures)
    return _set_background(settings, _colour(mean_colour(pictures) if backdrop_colour is None else backdrop_colour))


def _colour(levels: NDArray[Any]) -> list[float]:
    colour: list[float] = np.round(levels / 255, 4).tolist()
    return colour


def _set_background(settings: Settings, background: Sequence[float]) -> Settings:
    scene = settings.scene.model_copy(update={"background": tuple(background)})
    return settings.model_copy(update={"scene": scene})


def with_recorded_background(settings: Settings, history: History) -> Settings:
    """Returns the settings with the background 'auto' replaced by a scene's recorded background.

    If the first frame of the scene cannot be read, the settings are returned unchanged.
    """
    if settings.scene.background != "auto":
        return settings
    with suppress(HistoryError):
        return _set_background(settings, history.background)
    return settings


@dataclass(frozen=True, eq=False)
class FirstFrame:
    """Data from frame 0 that every update needs.

    Attributes:
        masked: whether frame 0 has masks.
        exposures: maps each camera name to a [3, 2] array, the gain and offset of each colour channel.
        lengths: [N, 3] axis lengths of the Gaussians, in metres.
        background: background colour, RGB in [0, 1].
    """

    masked: bool
    exposures: dict[str, NDArray[np.float32]]
    lengths: NDArray[np.float32]
    background: Colour

    def record(self) -> dict[str, Any]:
        """Returns the data that the state of frame 0 does not contain, as JSON values.

        The values are included in the report of frame 0.
        """
        return {
            "masked": self.masked,
            "exposures": {name: exposure.tolist() for name, exposure in self.exposures.items()},
            "background": list(self.background),
        }

    @classmethod
    def of(cls, history: History) -> FirstFrame:
        """Reads the data from the first frame of a history.

        Raises:
            HistoryError: if the frame cannot be read.
            KeyError: if the frame's report is incomplete.
        """
        first = history.indices[0]
        report = history.report(first)
        masked = bool(report["masked"])
        exposures = {name: np.array(exposure, np.float32) for name, exposure in report["exposures"].items()}
        return cls(masked, exposures, axis_lengths(history.gaussians(first)), history.background)


def fit_first_frame(
    frame: Frame,
    points: InitialPoints | None,
    factory: ViewFactory,
    settings: Settings,
    world: WorldFrame,
    on_progress: Callable[[Progress], None],
) -> StaticResult:
    """Fits Gaussians to the images of frame 0, starting from a given or a computed point cloud.

    Points are computed in the internal world, so that the result does not depend on the user's
    origin and unit.

    Args:
        frame: images and masks of frame 0, at the image size of the factory's rig.
        points: initial point cloud in the user's world, or None to compute one.
        factory: factory that creates the scene's views.
        settings: settings of the scene.
        world: transform from the user's world to the internal world.
        on_progress: function called with the progress of each stage.
    """
    if points is None:
        load_stereo()
    static, limit = settings.static, TimeLimit(settings.static.seconds)
    if points is None:
        first_points = initial_points(
            factory.rig, frame.images, frame.masks,
            lambda stage, done, total: on_progress(Progress(stage, done, total, _remaining_time(limit))), limit=limit,
        )  # fmt: skip
        cloud, made, stage = (
            _columns(first_points),
            FirstCloud(first_points.method, len(first_points), first_points.coverage),
            first_points.stage,
        )
    else:
        inside = replace(points, positions=world.to_inside(points.positions))
        cloud, made, stage = _columns(inside), FirstCloud("given", len(points)), None
    views = factory.views(frame, {})
    result = fit_with_gloss_trial(
        lambda: first_trainer(
            factory, views, *cloud, settings.scene, static, limit, stage, resolve_device(settings.device)
        ),
        settings.effects.get("direction", "auto"),
        lambda now: on_progress(Progress("fitting frame 0", now.done, now.planned, _figures(now, limit))),
    )
    if result.ran_short_of_time and len(result.losses) <= (1 - REPORTED_SHORTFALL) * static.iterations:
        limit.shortened.append(f"{len(result.losses)} of {static.iterations} iterations (all phases shortened equally)")
    return replace(result, cloud=made, shortened=[*limit.shortened, *result.shortened])


def _remaining_time(limit: TimeLimit) -> dict[str, float]:
    """Returns the maximum remaining time of frame 0 in seconds, or {} without a limit."""
    return {"seconds_at_most": max(0.0, limit.seconds_left())} if limit.bounded else {}


def _figures(now: FitProgress, limit: TimeLimit) -> dict[str, float]:
    """Returns the loss and the remaining time, for a progress report."""
    left = {} if now.seconds is None else {"seconds_left": now.seconds}
    return {"loss": now.loss, **left, **_remaining_time(limit)}


def _columns(cloud: InitialPoints) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32] | None]:
    return cloud.positions, cloud.colours, cloud.foreground
