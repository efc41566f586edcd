"""Rasterizer in plain PyTorch: dense, slow and exact. In float64, it is the reference for all other engines.

The projection is EWA splatting (Zwicker et al. 2001) as in 3D Gaussian Splatting (Kerbl et al. 2023), with the Jacobian
clamping of gsplat. Camera axes follow OpenCV. The centre of the pixel in column i and row j is (i + 0.5, j + 0.5).
Gradients of means, factors, opacities and features are computed by autograd.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from scas4d_core.cameras import Camera
from scas4d_core.engines.limits import DEFAULT, Limits
from scas4d_core.engines.views import CameraArrays
from scas4d_core.guards import FEATURE_CEILING, NOT_FINITE

PAIRS_AT_ONCE = 4_000_000
"""Maximum number of pixel–Gaussian pairs in memory. Larger images are split into strips, which the backward pass
recomputes."""


class CameraParams(NamedTuple):
    """A camera as tensors.

    Attributes:
        rotation: [3, 3] world-to-camera rotation.
        translation: [3] world-to-camera translation, in metres.
        fx, fy, cx, cy: intrinsics, in pixels.
        width, height: image size, in pixels.
    """

    rotation: Tensor
    translation: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @classmethod
    def of(cls, camera: Camera, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> CameraParams:
        """Converts a camera to tensors with the given dtype and device."""
        rotation = torch.tensor(camera.rotation, dtype=dtype, device=device)
        translation = torch.tensor(camera.translation, dtype=dtype, device=device)
        fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
        return cls(rotation, translation, fx, fy, cx, cy, camera.width, camera.height)

    @classmethod
    def of_arrays(cls, camera: CameraArrays) -> CameraParams:
        """Converts a camera in kernel format to float64 tensors."""
        pose = torch.as_tensor(camera.pose, dtype=torch.float64)
        fx, fy, cx, cy = camera.lens[:4].astype(float).tolist()
        return cls(pose[:, :3], pose[:, 3], fx, fy, cx, cy, camera.width, camera.height)

    def depths(self, means: Tensor) -> Tensor:
        """Returns the depth [N] of points [N, 3] along the camera's z axis, for rendering depth as a feature."""
        return means @ self.rotation[2] + self.translation[2]


class Projected(NamedTuple):
    """Projected Gaussians. Values are meaningless for Gaussians closer than the near plane.

    Attributes:
        means: [N, 2] projected means, in pixels.
        covariances: [N, 2, 2] projected covariances including the low-pass filter, in pixels².
        depths: [N] depths along z, in metres.
    """

    means: Tensor
    covariances: Tensor
    depths: Tensor


class Rendered(NamedTuple):
    """A rendered image.

    Attributes:
        features: [H, W, C] rendered features, including the background.
        alpha: [H, W] alpha in [0, 1], one minus the remaining transmittance.
        pairs: [H, W] number of Gaussians blended into each pixel.
        means: [N, 2] projected means, in pixels. Adaptive density control uses their gradient.
        depths: [N] depths along z, in metres.
    """

    features: Tensor
    alpha: Tensor
    pairs: Tensor
    means: Tensor
    depths: Tensor


def project(means: Tensor, factors: Tensor, camera: CameraParams, limits: Limits = DEFAULT) -> Projected:
    """Computes the EWA projection: cov2d = (A F)(A F)ᵀ + low_pass·I, with the 2×3 matrix A = J_projection·W.

    The Jacobian is evaluated with x/z and y/z clamped to the image extended by ``tangent_margin``. The means are not
    clamped.

    Args:
        means: [N, 3] means, in metres.
        factors: [N, 3, 3] covariance factors.
        camera: camera in internal world coordinates.
        limits: rasterizer constants.
    """
    x, y, z = (means @ camera.rotation.T + camera.translation).unbind(-1)
    # For culled Gaussians, division by z could make gradients NaN. They are not rendered, so any positive z works.
    z_safe = torch.where(z < limits.near, torch.full_like(z, limits.near), z)
    tan_x, tan_y = x / z_safe, y / z_safe
    margin_x = limits.tangent_margin * camera.width / (2 * camera.fx)
    margin_y = limits.tangent_margin * camera.height / (2 * camera.fy)
    held_x = tan_x.clamp(-(camera.cx / camera.fx + margin_x), (camera.width - camera.cx) / camera.fx + margin_x)
    held_y = tan_y.clamp(-(camera.cy / camera.fy + margin_y), (camera.height - camera.cy) / camera.fy + margin_y)
    zero = torch.zeros_like(z)
    row_u = torch.stack([camera.fx / z_safe, zero, -camera.fx * held_x / z_safe], dim=-1)
    row_v = torch.stack([zero, camera.fy / z_safe, -camera.fy * held_y / z_safe], dim=-1)
    spread = torch.stack([row_u, row_v], dim=-2) @ camera.rotation @ factors
    low_pass = limits.low_pass * torch.eye(2, dtype=means.dtype, device=means.device)
    uv = torch.stack([camera.fx * tan_x + camera.cx, camera.fy * tan_y + camera.cy], dim=-1)
    return Projected(uv, spread @ spread.mT + low_pass, z)


def _composite(
    pixels: Tensor,
    means: Tensor,
    conics: Tensor,
    opacities: Tensor,
    features: Tensor,
    background: Tensor,
    limits: Limits,
) -> tuple[Tensor, Tensor, Tensor]:
    """Composites depth-sorted Gaussians at pixel centres [P, 2], and returns features [P, C], alpha and pairs [P]."""
    d = pixels[:, None] - means
    a, b, c = conics.unbind(-1)
    power = -0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) - b * d[..., 0] * d[..., 1]
    alpha = (opacities * torch.exp(power)).clamp(max=limits.alpha_cap)
    alpha = torch.where(alpha >= limits.alpha_floor, alpha, 0)
    # Transmittance decreases monotonically, so a pixel that falls below the threshold stays finished.
    passed = torch.cumprod(1 - alpha.detach(), dim=1)
    alpha = torch.where(passed >= limits.transmittance_stop, alpha, 0)
    passed = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)
    remaining = passed[:, -1]
    pairs = (alpha > 0).sum(dim=1)
    return (alpha * before) @ features + remaining[:, None] * background, 1 - remaining, pairs


def sound(means: Tensor, factors: Tensor, opacities: Tensor, features: Tensor) -> Tensor:
    """Returns a mask [N] of the Gaussians whose values are finite and within ``NOT_FINITE`` and ``FEATURE_CEILING``."""
    size = means.detach().abs().sum(-1) + factors.detach().abs().sum((-2, -1)) + opacities.detach().abs()
    return (size <= NOT_FINITE) & (features.detach().abs() <= FEATURE_CEILING).all(-1)


def render(
    means: Tensor,
    factors: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: CameraParams,
    background: Tensor,
    limits: Limits = DEFAULT,
) -> Rendered:
    """Renders Σ_i w_i·feature_i + T_final·background at every pixel, front to back. Ties in depth keep row order.

    alpha = min(cap, o·exp(−½ dᵀ cov2d⁻¹ d)), where d is the offset of the pixel centre from the projected mean. A
    Gaussian contributes if and only if alpha ≥ floor. Blending stops at the first Gaussian with T·(1 − alpha) < stop,
    which is not blended. No gradient flows through the cap. Gaussians that are not ``sound`` are not rendered and have
    zero gradients.

    Args:
        means: [N, 3] means, in metres.
        factors: [N, 3, 3] covariance factors F, with Σ = F Fᵀ.
        opacities: [N] opacities in (0, 1).
        features: [N, C] features with C ≥ 1, for example colour, label and depth in one pass.
        camera: camera in internal world coordinates.
        background: [C] background features.
        limits: rasterizer constants.

    >>> from scas4d_core.gaussians import Gaussians
    >>> state = Gaussians.of_points([[0, 0, 2]], radius=0.1, colours=[1, 0, 0])
    >>> means, factors, opacities, colours = (
    ...     torch.tensor(array, dtype=torch.float64)
    ...     for array in (state.means, state.factors, state.opacities, state.colours)
    ... )
    >>> camera = Camera("front", [[100, 0, 8], [0, 100, 8], [0, 0, 1]], torch.eye(4).numpy(), 16, 16)
    >>> picture = render(means, factors, opacities, colours, CameraParams.of(camera), torch.zeros(3))
    >>> picture.features[8, 8].round(decimals=2), picture.alpha.shape
    (tensor([0.8900, 0.0000, 0.0000], dtype=torch.float64), torch.Size([16, 16]))
    """
    finite = sound(means, factors, opacities, features)
    if not bool(finite.all()):
        # Move invalid Gaussians behind the camera, and replace values that would become NaN when multiplied by 0.
        away = (-camera.translation - camera.rotation[2]) @ camera.rotation
        means = torch.where(finite[:, None], means, away)
        factors = torch.where(finite[:, None, None], factors, 0)
        opacities = torch.where(finite, opacities, 0)
        features = torch.where(finite[:, None], features, 0)
    projected = project(means, factors, camera, limits)
    visible = torch.nonzero(projected.depths.detach() >= limits.near)[:, 0]
    order = visible[torch.argsort(projected.depths.detach()[visible], stable=True)]
    columns = torch.arange(camera.width, dtype=means.dtype, device=means.device) + 0.5
    rows = torch.arange(camera.height, dtype=means.dtype, device=means.device) + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    pixels = torch.stack([u, v], dim=-1).reshape(-1, 2)
    shape = (camera.height, camera.width)
    if len(order) == 0:
        empty = background.expand(*shape, -1) + 0 * features.sum()
        none = means.new_zeros(shape, dtype=torch.int64)
        return Rendered(empty, means.new_zeros(shape), none, projected.means, projected.depths)
    (xx, xy), (_, yy) = (row.unbind(-1) for row in projected.covariances[order].unbind(-2))
    conics = torch.stack([yy, -xy, xx], dim=-1) / (xx * yy - xy * xy)[:, None]
    drawn = (projected.means[order], conics, opacities[order], features[order], background, limits)
    strips = torch.split(pixels, max(1, PAIRS_AT_ONCE // len(order)))
    if len(strips) == 1:
        parts = [_composite(pixels, *drawn)]
    else:
        parts = [checkpoint(_composite, strip, *drawn, use_reentrant=False) for strip in strips]
    picture = torch.cat([part[0] for part in parts]).reshape(*shape, -1)
    alpha, pairs = (torch.cat([part[place] for part in parts]).reshape(shape) for place in (1, 2))
    return Rendered(picture, alpha, pairs, projected.means, projected.depths)
