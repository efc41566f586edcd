"""Result of fitting frame 0, and where its first cloud came from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scas4d_core.effects.evidence import Evidence
from scas4d_core.gaussians import Gaussians
from scas4d_core.update.result import CameraFit

Array = NDArray[np.float32]


@dataclass(frozen=True)
class FirstCloud:
    """Where the first cloud of points came from.

    Attributes:
        method: "given", or as in ``initial_points.InitialCloud``. points: how many.
        coverage: share of the pictures that points cover on which cameras agree; None of a cloud that was given.
    """

    method: str
    points: int
    coverage: float | None = None


@dataclass(frozen=True, eq=False)
class StaticResult:
    """Result of fitting frame 0.

    Attributes:
        gaussians: Θ_0. exposures: [3, 2] gain and offset of each training camera; empty without exposure terms.
        losses: the training loss of every iteration. psnr: dB of the view that each iteration rendered.
        cameras: by name, the fit of each camera's picture in its last iteration.
        evidence: that was found for effects, by name.
        cloud: where the first cloud came from; None where it is not known.
        planned: (iteration, iterations in all) whenever the time that was left changed what was planned.
        ran_short_of_time: whether an iteration has gone on by more than one of the schedule.
        shortened: what the time of frame 0 was too short for, in words.
    """

    gaussians: Gaussians
    exposures: dict[str, Array]
    losses: list[float]
    psnr: list[float] = field(default_factory=list)
    cameras: dict[str, CameraFit] = field(default_factory=dict)
    evidence: Mapping[str, Evidence] | None = None
    cloud: FirstCloud | None = None
    planned: Sequence[tuple[int, int]] = ()
    ran_short_of_time: bool = False
    shortened: Sequence[str] = ()
