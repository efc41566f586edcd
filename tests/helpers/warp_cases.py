"""Pictures for the tests of the Warp kernels, and the reference's view of them."""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
import pytest
import torch

from scas4d_core.cameras import Camera
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.torch.rasterizer import CameraParams, render
from scas4d_core.engines.views import CameraArrays, TrainingView

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")

DEVICE = os.environ.get("SCAS4D_WARP_DEVICE", "cpu")
"""Of Warp; "cuda:0" runs the same tests on a GPU."""
LIMITS = Limits(near=0.2)
BACKGROUND = (0.1, 0.2, 0.3)


class Cloud(NamedTuple):
    """Gaussians as arrays: means [N, 3], factors [N, 3, 3], opacities [N], features [N, 4]."""

    means: np.ndarray
    factors: np.ndarray
    opacities: np.ndarray
    features: np.ndarray

    def on_device(self) -> list[wp.array]:
        kinds = wp.vec3, wp.mat33, wp.float32, wp.vec4
        return [wp.array(array, dtype=kind, device=DEVICE) for array, kind in zip(self, kinds, strict=True)]

    def tensors(self) -> list[torch.Tensor]:
        return [torch.tensor(array, dtype=torch.float64, requires_grad=True) for array in self]


def cloud(count: int, seed: int = 0, radius: float = 0.4, faint: float = 0.02) -> Cloud:
    """Gaussians about the origin, of all shapes and of opacities from ``faint`` on."""
    rng = np.random.default_rng(seed)
    factors = np.linalg.qr(rng.standard_normal((count, 3, 3)))[0] * rng.uniform(0.005, 0.12, (count, 1, 3))
    made = (
        radius * rng.standard_normal((count, 3)), factors, rng.uniform(faint, 0.97, count),
        rng.uniform(0, 1, (count, 4)),
    )  # fmt: skip
    return Cloud(*(np.ascontiguousarray(array, np.float32) for array in made))


def camera(width: int, height: int, distance: float = 1.6) -> CameraArrays:
    """A camera that looks at the origin from in front, a little turned, its centre beside the picture's."""
    turn = 0.2
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]
    pose[2, 3] = distance
    size = max(width, height)
    k = [[1.1 * size, 0, 0.52 * width], [0, 1.15 * size, 0.47 * height], [0, 0, 1]]
    return CameraArrays.of(Camera("front", k, pose, width, height))


def view_of(picture: np.ndarray, shot: CameraArrays, seed: int = 0, mask: bool = True) -> TrainingView:
    """A noisy picture [4, H, W] with an exposure."""
    rng = np.random.default_rng(seed)
    target = picture + rng.normal(0, 0.05, picture.shape)
    target[3] = target[3] > 0.5
    target = np.ascontiguousarray(target[: 3 + mask], np.float32)
    exposure = np.float32([[1.05, -0.01], [0.97, 0.02], [1.0, 0.0], [1.0, 0.0]][: 3 + mask])
    return TrainingView("front", shot, target, exposure)


def drawn(
    tensors: list[torch.Tensor],
    shot: CameraArrays,
    limits: Limits = LIMITS,
    background: tuple[float, float, float] = BACKGROUND,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Features [H, W, 4] and transmittance [H, W] of the reference."""
    behind = torch.tensor([*background, 0], dtype=torch.float64)
    picture = render(*tensors, CameraParams.of_arrays(shot), behind, limits)
    return picture.features, 1 - picture.alpha


def index(number: int) -> wp.array:
    """A number on the device."""
    return wp.array([number], dtype=wp.int32, device=DEVICE)
