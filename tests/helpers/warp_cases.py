"""Pictures for the tests of the Warp kernels, and the reference's view of them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from scas4d_core.cameras import Camera
from scas4d_core.engines.limits import Limits
from scas4d_core.engines.torch.rasterizer import CameraParams, render
from scas4d_core.engines.views import CameraArrays, TrainingView

wp = pytest.importorskip("warp", reason="NVIDIA Warp is not installed: pip install warp-lang")
downloads = pytest.importorskip("scas4d_core.engines.warp.downloads")

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


class Waits:
    """Counts how often the host waits for results of the device, from now on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.count = 0
        read = downloads.Downloads.read

        def counted(own: Any, *arrays: wp.array) -> list[NDArray[Any]]:
            self.count += 1
            copies: list[NDArray[Any]] = read(own, *arrays)
            return copies

        monkeypatch.setattr(downloads.Downloads, "read", counted)


class Uploads:
    """Counts bytes that go to the device as NumPy arrays or from page-locked buffers, by type, from now on.

    Structs and lists of a few numbers are not counted.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.bytes: Counter[str] = Counter()
        self._locked: list[wp.array] = []  # kept, so that no other array takes their place
        self._inside = False
        zeros, copy, construct, assign = wp.zeros, wp.copy, wp.array.__init__, wp.array.assign

        def made(*given: object, **named: object) -> wp.array:
            array = zeros(*given, **named)
            if "pinned" in named:
                self._locked.append(array)
            return array

        def copied(
            target: wp.array, source: wp.array, dest_offset: int = 0, src_offset: int = 0, count: int = 0
        ) -> None:
            if any(one.ptr <= source.ptr < one.ptr + one.capacity for one in self._locked):
                self._add(source.dtype, (count or source.size) * wp.types.type_size_in_bytes(source.dtype))
            copy(target, source, dest_offset, src_offset, count)

        def constructed(array: wp.array, data: object = None, *given: object, **named: object) -> None:
            self._watch(array, data, lambda: construct(array, data, *given, **named))

        def assigned(array: wp.array, values: object) -> None:
            self._watch(array, np.asarray(values), lambda: assign(array, values))

        monkeypatch.setattr(wp, "zeros", made)
        monkeypatch.setattr(wp, "copy", copied)
        monkeypatch.setattr(wp.array, "__init__", constructed)
        monkeypatch.setattr(wp.array, "assign", assigned)

    def _watch(self, array: wp.array, data: object, act: Callable[[], None]) -> None:
        """Counts the data of the outermost call, in the type that it has on the device."""
        if self._inside:
            return act()
        self._inside = True
        act()
        self._inside = False
        if isinstance(data, np.ndarray):
            self._add(array.dtype, array.size * wp.types.type_size_in_bytes(array.dtype))

    def _add(self, kind: object, size: int) -> None:
        name = "uint8" if kind is wp.uint8 else str(kind)
        self.bytes[name] += size
