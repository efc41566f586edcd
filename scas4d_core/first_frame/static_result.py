"""Result of fitting frame 0, and the origin of its initial points."""

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
        method: "given" for a cloud supplied by the user, otherwise the methods used; see
            ``initial_points.InitialCloud``.
        points: number of points.
        coverage: fraction of the image area covered by points on which cameras agree, or None for a
            cloud supplied by the user.
    """

    method: str
    points: int
    coverage: float | None = None


@dataclass(frozen=True, eq=False)
class StaticResult:
    """Result of fitting frame 0.

    Attributes:
        gaussians: fitted Gaussians Θ_0.
        exposures: maps each training camera to a [3, 2] array, the gain and offset of each colour channel; empty
            without exposure terms.
        losses: training loss of each iteration.
        psnr: PSNR of the view rendered in each iteration, in dB.
        cameras: how well each camera's image was fitted in its last iteration, keyed by camera name.
        evidence: evidence for each effect that a trial tested, keyed by effect name, or None if
            trials were disabled.
        cloud: origin of the initial points, or None if unknown.
        planned: (iteration, total iterations) at each change of plan.
        ran_short_of_time: whether any iteration advanced the schedule by more than one iteration.
        shortened: descriptions of the steps that were shortened or skipped for lack of time.
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
