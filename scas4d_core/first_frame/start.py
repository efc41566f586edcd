"""Fits frame 0, and keeps the facts of it that every update needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import WorldFrame
from scas4d_core.captures.frame import Frame, InitialPoints
from scas4d_core.first_frame.initial_points import initial_points
from scas4d_core.first_frame.static_scene import StaticResult, fit_static_scene
from scas4d_core.frame_report import Progress
from scas4d_core.robust.checks import axis_lengths
from scas4d_core.settings import Settings
from scas4d_core.storage.history import History
from scas4d_core.update.picture_loss import ViewFactory


@dataclass(frozen=True, eq=False)
class FirstFrame:
    """The facts of frame 0 that every update needs.

    Attributes:
        masked: true where it had masks. exposures: [3, 2] gain and offset of each channel, by camera name.
        lengths: [N, 3] metres, of the axes of the Gaussians.
    """

    masked: bool
    exposures: dict[str, NDArray[np.float32]]
    lengths: NDArray[np.float32]

    def record(self) -> dict[str, Any]:
        """The facts that the state of frame 0 does not hold, as JSON values; they are committed with its report."""
        return {
            "masked": self.masked,
            "exposures": {name: exposure.tolist() for name, exposure in self.exposures.items()},
        }

    @classmethod
    def of(cls, history: History) -> FirstFrame:
        """Reads the facts from the first frame of a history.

        Raises:
            HistoryError: it cannot be read. KeyError: its report lacks something.
        """
        first = history.indices[0]
        report = history.report(first)
        masked = bool(report["masked"])
        exposures = {name: np.array(exposure, np.float32) for name, exposure in report["exposures"].items()}
        return cls(masked, exposures, axis_lengths(history.gaussians(first)))


def fit_first(
    frame: Frame,
    points: InitialPoints | None,
    factory: ViewFactory,
    settings: Settings,
    world: WorldFrame,
    on_progress: Callable[[Progress], None],
) -> StaticResult:
    """Fits frame 0 to its pictures, from a cloud that is given or made from the pictures.

    The cloud is made in the inside world: the user's origin and unit do not change it.

    Args:
        frame: with pictures of the size of the factory's rig. points: in the user's world. world: user's to inside.
        on_progress: called with the progress of each stage.
    """
    static = settings.static
    if points is None:
        points = initial_points(
            factory.rig, frame.images, frame.masks,
            lambda stage, done, total: on_progress(Progress(stage, done, total)),
        )  # fmt: skip
        positions = points.positions
    else:
        positions = world.to_inside(points.positions)
    return fit_static_scene(
        factory,
        factory.views(frame, {}),
        positions,
        points.colours,
        points.foreground,
        settings.scene,
        static,
        lambda done, loss: on_progress(Progress("fitting frame 0", done, static.iterations, {"loss": loss})),
    )
