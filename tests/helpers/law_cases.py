"""What the laws are tried on: the profile of hypothesis, and made-up deformations, graphs and scenes by seed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from scas4d_core.cameras import Camera
from scas4d_core.engines.cpu.deformation import CpuDeformation
from scas4d_core.engines.torch.deformation import ClusterMap, ClusterParams, Deltas, Layer
from scas4d_core.gaussians import Gaussians
from scas4d_core.structure.hierarchy import Hierarchy

seeds = st.integers(0, 2**32 - 1)
"""Where numbers of a law are drawn from a generator: a failure names one integer."""


def law(examples: int) -> Callable[[Any], Any]:
    """The profile: the same examples in every run, on every machine, however long one takes."""
    return settings(
        max_examples=examples, derandomize=True, deadline=None, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
    )  # fmt: skip


def doubles(array: Any) -> Tensor:
    """A float64 tensor of its own."""
    return torch.tensor(np.asarray(array, dtype=np.float64))


class Motion(NamedTuple):
    """M Gaussians, the layers of clusters over them, and what each adds; float64."""

    means: Tensor
    factors: Tensor
    layers: list[Layer]
    deltas: Deltas


def some_motion(seed: int, count: int = 12, scale: float = 0.3, layers: int = 2) -> Motion:
    """Gaussians in a cube of 2 m; ``scale`` is the standard deviation of the parameters (1: folds are common)."""
    rng = np.random.default_rng(seed)
    most = 2 * 3 ** (layers - 1)
    finest = np.sort(np.concatenate([np.arange(most), rng.integers(0, most, count - most)]))
    made = []
    for layer in range(layers):
        params = scale * rng.normal(size=(2 * 3**layer, 10))
        parts = (params[:, :3], params[:, 3:6], params[:, 6:9], params[:, 9])
        made.append(Layer(torch.tensor(finest // 3 ** (layers - 1 - layer)), ClusterParams(*map(doubles, parts))))
    own = 0.3 * scale * rng.normal(size=(3, count, 3))
    means, factors = rng.uniform(-1, 1, (count, 3)), 0.2 * rng.normal(size=(count, 3, 3))
    return Motion(doubles(means), doubles(factors), made, Deltas(*map(doubles, own)))


def some_rotation(seed: int) -> np.ndarray:
    """[3, 3], uniform over all rotations."""
    return Rotation.random(random_state=seed % 2**32).as_matrix()


def on_cpu(motion: Motion, kind: ClusterMap = "centred") -> CpuDeformation:
    """The same deformation as the fused kernels compute it, in float32."""
    labels = [layer.labels.numpy() for layer in motion.layers]
    starts = tuple(np.searchsorted(of, np.arange(of.max() + 2)).astype(np.int64) for of in labels)
    count = len(motion.means)
    hierarchy = Hierarchy(np.arange(count), tuple(of.astype(np.int32) for of in labels), starts)
    made = CpuDeformation(hierarchy, None, np.full((count, 3), 1e9, np.float32), kind)
    made.start(gaussians(motion.means, motion.factors))
    for table, (_, (r, t, c, s)) in zip(made.clusters, motion.layers, strict=True):
        table[:] = torch.cat([r, t, c, s[:, None]], dim=1).numpy()
    made.deltas[:] = torch.cat(motion.deltas, dim=1).numpy()
    made.forward()
    return made


def gaussians(means: Tensor, factors: Tensor) -> Gaussians:
    """A state of grey Gaussians that all move."""
    count = len(means)
    return Gaussians(
        means=means.numpy().astype(np.float32),
        factors=factors.numpy().astype(np.float32),
        rotations=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        opacities=np.full(count, 0.8, np.float32),
        colours=np.full((count, 3), 0.5, np.float32),
        foreground=np.ones(count, np.float32),
        ids=np.arange(count),
    )


class Splats(NamedTuple):
    """What a rasterizer is given, float64, and the camera that sees it."""

    means: Tensor
    factors: Tensor
    opacities: Tensor
    features: Tensor
    background: Tensor
    camera: Camera


def some_splats(seed: int, count: int = 5, size: tuple[int, int] = (9, 7), channels: int = 2) -> Splats:
    """A few Gaussians before a small camera that looks at them from 2 m, turned and off the middle."""
    rng = np.random.default_rng(seed)
    width, height = size
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.5, 3)).as_matrix()
    pose[2, 3] = 2.0
    focal = 1.1 * width
    camera = Camera(
        "c", np.array([[focal, 0, width / 2 + 0.3], [0, 1.1 * focal, height / 2 - 0.4], [0, 0, 1]]), pose, width, height
    )
    return Splats(
        doubles(rng.normal(0, 0.25, (count, 3))),
        doubles(Rotation.random(count, random_state=seed % 2**32).as_matrix() * rng.uniform(0.05, 0.3, (count, 1, 3))),
        doubles(rng.uniform(0.2, 0.95, count)),
        doubles(rng.uniform(0, 1, (count, channels))),
        doubles(rng.uniform(0, 1, channels)),
        camera,
    )
