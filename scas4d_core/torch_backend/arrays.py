"""Numpy arrays that a torch update takes and returns: neighbours, parameters, views, weights and the result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scas4d_core.cameras import Camera
from scas4d_core.gaussians import Gaussians

Floats: TypeAlias = NDArray[np.floating[Any]]


class Graph(NamedTuple):
    """Neighbours among the M moving Gaussians, as they were when the graph was built.

    Attributes:
        neighbours: [M, k] int64 rows among the moving.
        weights: [M, k], exp(−falloff·d²).
        distances: [M, k] metres.
    """

    neighbours: NDArray[np.int64]
    weights: Floats
    distances: Floats


class ClusterArrays(NamedTuple):
    """``ClusterParams`` as numpy: r [K, 3], t [K, 3] metres, c [K, 3] per metre, s [K]."""

    r: Floats
    t: Floats
    c: Floats
    s: Floats


class DeltaArrays(NamedTuple):
    """``Deltas`` as numpy: dp [M, 3] metres, dr [M, 3], ds [M, 3]."""

    dp: Floats
    dr: Floats
    ds: Floats


class TorchView(NamedTuple):
    """One camera's pictures of a frame.

    Attributes:
        camera: of the inside world, of the picture's size.
        image: [H, W, 3] in 0…1.
        mask: [H, W] in 0…1, or None.
        exposure: [3, 2] the camera's gain and offset of each colour; None: 1 and 0.
    """

    camera: Camera
    image: Floats
    mask: Floats | None
    exposure: Floats | None = None


@dataclass(frozen=True)
class TermWeights:
    """Weights of the terms; a term of weight 0 is not computed."""

    image: float = 1.0
    mask: float = 3.0
    rigidity: float = 4.0
    isometry: float = 2.0
    rotation: float = 4.0
    scale: float = 10.0
    soft_colour: float = 0.01


class TorchResult(NamedTuple):
    """The state and the parameters that one update found.

    Attributes:
        gaussians: Θ_t, float32.
        turns: [M, 4] unit quaternions with w ≥ 0, rotation of the moving Gaussians since Θ_{t−1}.
        layers: cluster parameters at the end, coarse to fine; the next frame's warm start.
        deltas: per Gaussian at the end.
        losses: one weighted sum an iteration.
        psnr: dB, of each view that was rendered, in order.
    """

    gaussians: Gaussians
    turns: NDArray[np.float32]
    layers: list[ClusterArrays]
    deltas: DeltaArrays
    losses: list[float]
    psnr: list[float]
