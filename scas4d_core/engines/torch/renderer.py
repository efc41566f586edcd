"""Renderer in PyTorch with float64, the reference for all other renderers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scas4d_core.engines.host_renderer import HostRenderer
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.renderer import (
    BLOCK,
    Comparison,
    Picture,
)
from scas4d_core.engines.torch import losses
from scas4d_core.engines.torch.gloss import colours_seen, no_turns
from scas4d_core.engines.torch.parameters import leaf
from scas4d_core.engines.torch.rasterizer import CameraParams, Rendered, project, render
from scas4d_core.engines.views import LABEL, CameraArrays, TrainingView
from scas4d_core.gaussians import Gaussians

Array = NDArray[np.float32]
TILE = 32
"""Tile size in pixels. ``reached`` pads images to whole tiles."""


class TorchRenderer(HostRenderer):
    """The reference implementation of ``Renderer``.

    Args:
        background: background colour, RGB in [0, 1].
        limits: rasterizer constants.
    """

    def __init__(self, background: tuple[float, float, float], limits: Limits = DEFAULT) -> None:
        self._background, self._limits = background, limits

    def render(
        self,
        state: Gaussians,
        camera: CameraArrays,
        features: Array | None = None,
        *,
        depth_channel: int = -1,
        background: Array | None = None,
    ) -> Picture:
        """See ``Renderer.render``."""
        shown = self._seen(state, camera) if features is None else leaf(features)
        if depth_channel >= 0:
            shown[:, depth_channel] = CameraParams.of_arrays(camera).depths(leaf(state.means))
        picture = self._drawn(state, camera, shown, background)
        return Picture(picture.features.permute(2, 0, 1).float().numpy(), (1 - picture.alpha).float().numpy())

    def compare(self, state: Gaussians, views: Sequence[TrainingView]) -> list[Comparison]:
        """See ``Renderer.compare``."""
        return [self._compared(state, view) for view in views]

    def _compared(self, state: Gaussians, view: TrainingView) -> Comparison:
        planes = leaf(self.render(state, view.camera).features[:LABEL])
        shown = planes * leaf(view.exposure[:3, 0])[:, None, None] + leaf(view.exposure[:3, 1])[:, None, None]
        picture, target = shown.permute(1, 2, 0), leaf(view.target[:LABEL]).permute(1, 2, 0)
        red, green, blue = (view.mean - shown.mean(dim=(1, 2)).numpy()).tolist()
        loss = float(losses.image_loss(picture, target))
        return Comparison(float(losses.psnr(picture, target)), loss, (red, green, blue))

    def gather(self, state: Gaussians, camera: CameraArrays, planes: Array) -> Array:
        """See ``Renderer.gather``. The sums are computed as feature gradients of a weighted sum of pixels."""
        features = torch.zeros(len(state), len(planes), dtype=torch.float64, requires_grad=True)
        picture = self._drawn(state, camera, features, np.zeros(len(planes), np.float32))
        (picture.features * leaf(planes).permute(1, 2, 0)).sum().backward()  # type: ignore[no-untyped-call]
        assert features.grad is not None
        sums: Array = features.grad.float().numpy()
        return sums

    def residuals(
        self, state: Gaussians, view: TrainingView, learnt: NDArray[np.uint8], most: float
    ) -> tuple[Array, Array]:
        """See ``HostRenderer.residuals``."""
        shown = self.render(state, view.camera).features[:LABEL]
        gain, offset = view.exposure[:3, :1, None], view.exposure[:3, 1:, None]
        more = np.clip((view.target[:LABEL] - offset) / gain - shown, -most, most)
        sums = self.gather(state, view.camera, np.concatenate([more, np.ones_like(more[:1])]))
        sums *= learnt[:, None]
        return sums[:, :LABEL], sums[:, LABEL]

    def reached(self, state: Gaussians, cameras: Sequence[CameraArrays]) -> list[NDArray[np.bool_]]:
        """See ``Renderer.reached``. A block is marked if a support contains one of its pixel centres."""
        moving = state.rows(np.flatnonzero(state.moving))
        return [self._blocks(moving, camera) for camera in cameras]

    def _blocks(self, chosen: Gaussians, camera: CameraArrays) -> NDArray[np.bool_]:
        """Returns the mask of the blocks in which a Gaussian's support contains a pixel centre."""
        params = CameraParams.of_arrays(camera)
        drawn = project(leaf(chosen.means), leaf(chosen.factors), params, self._limits)
        u = torch.arange(camera.width, dtype=torch.float64) + 0.5
        v = torch.arange(camera.height, dtype=torch.float64) + 0.5
        inside = torch.zeros(camera.height, camera.width, dtype=torch.bool)
        for mean, inverse, opacity, depth in zip(
            drawn.means, torch.linalg.inv(drawn.covariances), leaf(chosen.opacities), drawn.depths, strict=True
        ):
            if depth >= self._limits.near:
                dv, du = torch.meshgrid(v - mean[1], u - mean[0], indexing="ij")
                power = inverse[0, 0] * du**2 + 2 * inverse[0, 1] * du * dv + inverse[1, 1] * dv**2
                inside |= opacity * torch.exp(-0.5 * power) >= self._limits.alpha_floor
        height, width = (-(-size // TILE) * TILE // BLOCK for size in inside.shape)
        padded = torch.zeros(height * BLOCK, width * BLOCK, dtype=torch.bool)
        padded[: inside.shape[0], : inside.shape[1]] = inside
        blocks: NDArray[np.bool_] = padded.reshape(height, BLOCK, width, BLOCK).any(dim=3).any(dim=1).numpy()
        return blocks

    def pairs_per_pixel(
        self, state: Gaussians, cameras: Sequence[CameraArrays], every: int = 1
    ) -> list[NDArray[np.int32]]:
        """See ``Renderer.pairs_per_pixel``."""
        drawn = [self._drawn(state, camera, self._seen(state, camera), None) for camera in cameras]
        return [each.pairs[::every, ::every].numpy().astype(np.int32) for each in drawn]

    def _seen(self, state: Gaussians, camera: CameraArrays) -> Tensor:
        """Returns the features [N, 4] of a state as seen by a camera: RGB including gloss, and label."""
        gloss = None if state.gloss is None else leaf(state.gloss)
        environment = None if state.environment is None else leaf(state.environment)
        means, colours = leaf(state.means), leaf(state.colours)
        seen = colours_seen(means, no_turns(len(state)), colours, gloss, environment, leaf(camera.centre))
        return torch.cat([seen, leaf(state.foreground)[:, None]], dim=1)

    def _drawn(self, state: Gaussians, camera: CameraArrays, features: Tensor, background: Array | None) -> Rendered:
        behind = torch.zeros(features.shape[1], dtype=torch.float64)
        behind[: len(self._background)] = leaf(self._background)
        if background is not None:
            behind = leaf(background)
        given = (leaf(state.means), leaf(state.factors), leaf(state.opacities), features)
        return render(*given, CameraParams.of_arrays(camera), behind, self._limits)
