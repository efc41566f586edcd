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
        method: "given" for a cloud from the user, otherwise the methods; see ``initial_points.InitialCloud``.
        points: number of points.
        coverage: fraction of the images covered by points on which cameras agree, or None for a given cloud.
    """

    method: str
    points: int
    coverage: float | None = None


@dataclass(frozen=True, eq=False)
class StaticResult:
    """Result of the fit of frame 0.

    Attributes:
        gaussians: fitted Gaussians Θ_0.
        exposures: [3, 2] gain and offset of each training camera, keyed by name; empty without exposure terms.
        losses: training loss of each iteration.
        psnr: PSNR of the view rendered in each iteration, in dB.
        cameras: fit of each camera's image in its last iteration, keyed by camera name.
        evidence: evidence for each effect, keyed by effect name, or None without a trial.
        cloud: origin of the initial points, or None if unknown.
        planned: (iteration, total iterations) at each change of plan.
        ran_short_of_time: whether any iteration advanced the schedule by more than one.
        shortened: descriptions of the steps that had too little time.
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
