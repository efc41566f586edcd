"""Forward and backward rendering passes for a set of Gaussians, on every backend."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from hard_cases.case import CPU, REFERENCE, BackendResult, apart, beyond, not_finite, unexpected_counts
from scas4d_core.cameras import Camera
from scas4d_core.engines.cpu.rasterizer import CpuRasterizer
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.views import CameraArrays

Array = NDArray[np.float32]

LEAST_LIGHT = 9e-5
"""Lower bound on the transmittance of the densest pixel, far above denormal numbers."""
KINK_SHARE = 0.005
"""Maximum fraction of pixels that may cross the alpha floor or the transmittance stop because of float32 rounding."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """Gaussians in front of a camera.

    The loss is a sum of the image's features and alpha, with a random weight for each pixel.

    Attributes:
        means: [N, 3] float32 means.
        factors: [N, 3, 3] float32 covariance factors.
        opacities: [N] float32 opacities.
        features: [N, 4] float32 features.
        camera: camera in internal world coordinates.
        bad: [N] mask of rows that must be excluded. They receive no gradient and must not affect the other rows.
        guards: expected counts of the CPU guards; None accepts any counts.
        value: tolerance of a pixel compared with float64, relative to the range of the features; not checked if None.
        gradient: tolerance of each gradient compared with float64, relative to its norm; not checked if None.
        bound: largest allowed gradient if all pixel weights are 1.
        weight: standard deviation of the pixel weights.
        limits: rasterizer limits.
        why: reason why agreement is not checked, if it is not.
    """

    means: Array
    factors: Array
    opacities: Array
    features: Array
    camera: Camera
    bad: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    guards: Mapping[str, int] | None = field(default_factory=dict)
    value: float | None = 2e-4
    gradient: float | None = 2e-3
    bound: float = 1e7
    weight: float = 1.0
    limits: Limits = DEFAULT
    why: str = ""

    def weights(self) -> tuple[Array, Array]:
        """Returns the random loss weights for the features [4, H, W] and for alpha [H, W]."""
        rng = np.random.default_rng(5)
        shape = (4, self.camera.height, self.camera.width)
        return (
            (self.weight * rng.normal(size=shape)).astype(np.float32),
            (self.weight * rng.normal(size=shape[1:])).astype(np.float32),
        )

    def run(self, backend: str) -> BackendResult | None:
        """Runs the forward and backward pass on a backend, or returns None for float32 PyTorch."""
        if backend == CPU:
            return self._cpu()
        if backend == REFERENCE:
            return self._twin()
        return None

    def _cpu(self) -> BackendResult:
        rasterizer = CpuRasterizer(self.limits)
        picture = rasterizer.forward(
            self.means, self.factors, self.opacities, self.features.copy(), CameraArrays.of(self.camera), BACKGROUND
        )
        values = {"features": picture.features.copy(), "alpha": 1 - picture.transmittance}
        g_image, g_alpha = rasterizer.gradient_buffers()
        height, width = self.camera.height, self.camera.width
        g_image[:, :height, :width], g_alpha[:height, :width] = self.weights()
        buffers = rasterizer.backward(g_image, g_alpha)
        names = ("means", "factors", "opacities", "features")
        gradients = {name: getattr(buffers, name).copy() for name in names}
        return BackendResult(values, gradients, dict(rasterizer.guards))

    def _twin(self) -> BackendResult:
        import torch

        from scas4d_core.engines.torch import rasterizer as twin

        dtype = torch.float64
        names = ("means", "factors", "opacities", "features")
        leaves = [torch.tensor(getattr(self, name), dtype=dtype, requires_grad=True) for name in names]
        drawn = leaves[0], leaves[1], leaves[2], leaves[3]
        camera = twin.CameraParams.of(self.camera, dtype)
        background = torch.tensor(BACKGROUND, dtype=dtype)
        picture = twin.render(*drawn, camera, background, self.limits)
        by_feature, by_alpha = (torch.tensor(weights, dtype=dtype) for weights in self.weights())
        features = torch.movedim(picture.features, -1, 0)
        loss = (features * by_feature).sum() + (picture.alpha * by_alpha).sum()
        gradients = torch.autograd.grad(loss, leaves, allow_unused=True)
        return BackendResult(
            {"features": features.detach().numpy(), "alpha": picture.alpha.detach().numpy()},
            {
                name: np.zeros(leaf.shape) if g is None else g.numpy()
                for name, leaf, g in zip(names, leaves, gradients, strict=True)
            },
        )

    def without(self, rows: NDArray[np.bool_]) -> Rendering:
        """Returns the problem without the given Gaussians."""
        kept = ~rows
        return replace(
            self, means=self.means[kept], factors=self.factors[kept], opacities=self.opacities[kept],
            features=self.features[kept], bad=np.zeros(int(kept.sum()), bool), guards=None,
        )  # fmt: skip

    def violations(self, outcomes: Mapping[str, BackendResult]) -> list[str]:
        """Returns a line for each violated check.

        The checks cover finite values, bounded gradients, the range of the image values, guard counts, the influence of
        invalid rows, and agreement with the reference.
        """
        faults = []
        for backend, outcome in outcomes.items():
            faults += not_finite(outcome, backend) + beyond(outcome, backend, self.bound * self.weight)
            faults += self._outside(outcome, backend) + self._touched(outcome, backend)
        if CPU in outcomes:
            faults += unexpected_counts(outcomes[CPU], self.guards)
            if self.bad.any():
                faults += self._spoilt(outcomes[CPU])
        if REFERENCE in outcomes:
            truth = outcomes[REFERENCE]
            for backend in set(outcomes) - {REFERENCE}:
                faults += self._disagreement(outcomes[backend], truth, backend)
        return faults

    def _range(self) -> tuple[float, float]:
        drawn = self.features[~self.bad] if self.bad.size else self.features
        drawn = np.concatenate([drawn, BACKGROUND[None]])
        return float(drawn.min()), float(drawn.max())

    def _outside(self, outcome: BackendResult, backend: str) -> list[str]:
        low, high = self._range()
        slack = 1e-4 * max(high - low, 1e-3)
        picture, alpha = outcome.values["features"], outcome.values["alpha"]
        faults = []
        if picture.min() < low - slack or picture.max() > high + slack:
            faults.append(
                f"{backend}: image values are {picture.min():.4g}…{picture.max():.4g}, but colours are "
                f"{low:.4g}…{high:.4g}"
            )
        if alpha.min() < -1e-5 or alpha.max() > 1 + 1e-5:
            faults.append(f"{backend}: alpha is in {alpha.min():.4g}…{alpha.max():.4g}")
        if alpha.size and 1 - alpha.max() < LEAST_LIGHT:
            faults.append(f"{backend}: the transmittance falls to {1 - alpha.max():.2g}, below {LEAST_LIGHT:g}")
        return faults

    def _touched(self, outcome: BackendResult, backend: str) -> list[str]:
        if not self.bad.any() or (backend == REFERENCE and self.value is None):
            return []
        return [
            f"{backend}: invalid rows have a nonzero gradient of {name}"
            for name, gradient in outcome.gradients.items()
            if np.any(gradient[self.bad] != 0)
        ]

    def _spoilt(self, outcome: BackendResult) -> list[str]:
        alone = self.without(self.bad)._cpu()
        same = all(np.array_equal(outcome.values[name], alone.values[name]) for name in alone.values) and all(
            np.array_equal(outcome.gradients[name][~self.bad], alone.gradients[name]) for name in alone.gradients
        )
        return [] if same else ["cpu: the image or the gradients of the other rows depend on the invalid rows"]

    def _disagreement(self, outcome: BackendResult, truth: BackendResult, backend: str) -> list[str]:
        faults = []
        if self.value is not None:
            low, high = self._range()
            off = np.abs(outcome.values["features"] - truth.values["features"]).max(axis=0) / max(high - low, 1e-3)
            share = float(np.mean(~(off <= self.value)))
            if share > KINK_SHARE and np.count_nonzero(off > self.value) > 1:
                faults.append(f"{backend}: {100 * share:.2g}% of the pixels differ by up to {off.max():.2g}")
        if self.gradient is not None:
            for name, expected in truth.gradients.items():
                distance = apart(outcome.gradients[name], expected, least=1e-9 * self.weight)
                if not distance <= self.gradient:
                    faults.append(f"{backend}: gradient of {name} differs by {distance:.2g}")
        return faults


BACKGROUND = np.array([0.1, 0.2, 0.3, 0.0], np.float32)
