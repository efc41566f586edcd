"""Result of the fit of frame 0, and the origin of its initial points."""

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
    """Origin of the initial point cloud.

    Attributes:
        method: "given", or as in ``initial_points.InitialCloud``. points: number of points.
        coverage: share of the images covered by points that cameras agree on; None for a given cloud.
    """

    method: str
    points: int
    coverage: float | None = None


@dataclass(frozen=True, eq=False)
class StaticResult:
    """Result of the fit of frame 0.

    Attributes:
        gaussians: Θ_0. exposures: [3, 2] gain and offset of each training camera; empty without exposure terms.
        losses: training loss of every iteration. psnr: dB, of the view rendered in each iteration.
        cameras: by name, fit of each camera's image in its last iteration.
        evidence: found for effects, by name.
        cloud: origin of the initial points; None if unknown.
        planned: (iteration, total iterations) for each change of plan.
        ran_short_of_time: whether any iteration advanced the schedule by more than one.
        shortened: steps that had too little time, in words.
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
