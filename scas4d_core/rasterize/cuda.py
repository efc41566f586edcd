"""The rasterizer on a CUDA device, through gsplat 1.5.3 (``pip install -e '.[cuda]'``).

Not yet run on a GPU: written against gsplat's sources. There too the centre of pixel (column i, row j) is
(i + 0.5, j + 0.5); order is by depth, ties by row; the cap (0.999), the floor (1/255), the transmittance stop (1e-4)
and the tangent margin (0.3) are compiled in. gsplat finishes a pixel at T ≤ stop where ours do at T < stop.
gsplat compiles its kernels at first use (minutes); set ``TORCH_CUDA_ARCH_LIST`` to the device's architecture.
"""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from scas4d_core.rasterize.limits import GSPLAT, Limits
from scas4d_core.rasterize.twin import CameraParams, Rendered

TILE = 16
"""Pixels, side of gsplat's tiles."""
UPPER = torch.triu_indices(3, 3)
"""The six entries of a symmetric 3×3 matrix in gsplat's order: 00, 01, 02, 11, 12, 22."""


def _gsplat() -> ModuleType:
    try:
        import gsplat
    except ImportError as error:
        raise ImportError(
            "device 'cuda' rasterizes with gsplat, which is not installed; run: pip install -e '.[cuda]', "
            "or choose device 'cpu'"
        ) from error
    module: ModuleType = gsplat
    return module


def render(
    means: Tensor,
    factors: Tensor,
    opacities: Tensor,
    features: Tensor,
    camera: CameraParams,
    background: Tensor,
    limits: Limits = GSPLAT,
) -> Rendered:
    """Features and alpha in one pass; arguments and result as of ``twin.render``, float32 on a CUDA device.

    Args:
        means: [N, 3] metres.
        factors: [N, 3, 3]; Σ = F Fᵀ.
        opacities: [N] in (0, 1).
        features: [N, C], 1 ≤ C ≤ 512.
        camera: of the inside world.
        background: [C].
        limits: ``GSPLAT``, with the low-pass and the near plane free.

    Raises:
        ImportError: gsplat is not installed.
        ValueError: limits that gsplat has compiled in otherwise.
    """
    gsplat = _gsplat()
    if limits._replace(low_pass=GSPLAT.low_pass, near=GSPLAT.near) != GSPLAT:
        raise ValueError(f"limits {limits} cannot be had from gsplat, which compiles in {GSPLAT}; pass limits.GSPLAT")
    width, height = camera.width, camera.height
    view = torch.eye(4, dtype=means.dtype, device=means.device)
    view[:3, :3], view[:3, 3] = camera.rotation, camera.translation
    k = means.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    covariances = (factors @ factors.mT)[:, UPPER[0], UPPER[1]]
    # Unpacked, so that rows stay rows: one view of N Gaussians has few enough to afford it.
    radii, means2d, depths, conics, _ = gsplat.fully_fused_projection(
        means, covariances, None, None, view[None], k[None], width, height,
        eps2d=limits.low_pass, near_plane=limits.near, packed=False, opacities=opacities,
    )  # fmt: skip
    across, down = -(-width // TILE), -(-height // TILE)
    _, crossings, flat = gsplat.isect_tiles(means2d, radii, depths, TILE, across, down, packed=False)
    offsets = gsplat.isect_offset_encode(crossings, 1, across, down)
    picture, alpha = gsplat.rasterize_to_pixels(
        means2d, conics, features[None], opacities[None], width, height, TILE,
        offsets.reshape(1, down, across), flat, backgrounds=background[None], packed=False,
    )  # fmt: skip
    return Rendered(picture[0], alpha[0, ..., 0], means2d[0], depths[0])
