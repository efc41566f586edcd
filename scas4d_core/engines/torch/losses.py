"""Loss terms of an update in plain PyTorch, the reference for the kernels of other engines.

The losses follow the SCas4D paper (equation (8): scale loss) and Dynamic3DGaussians, which introduced the local
rigidity, isometry and rotation terms. Each loss function returns an unweighted scalar in the dtype of its inputs.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional

from scas4d_core.engines.torch.deformation import quaternion_matrices
from scas4d_core.guards import ROOT_FLOOR, SMALLEST_SQUARE, SSIM_C1, SSIM_C2

SSIM_WINDOW = 11
"""Side length of the Gaussian window in pixels (Wang et al. 2004)."""
SSIM_SIGMA = 1.5
"""Standard deviation of the window in pixels."""
SSIM_SHARE = 0.2
"""Weight of 1 − SSIM in the image loss. The L1 term has the remaining weight (Kerbl et al. 2023)."""


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Returns the normalized Gaussian window [11]."""
    x = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    weights = torch.exp(-(x**2) / (2 * SSIM_SIGMA**2))
    return (weights / weights.sum()).to(dtype=dtype, device=device)


def _blurred(pictures: Tensor) -> Tensor:
    """Filters images [B, 1, H, W] with the SSIM window, with zero padding."""
    window = _window(pictures.dtype, pictures.device)
    half = SSIM_WINDOW // 2
    across = functional.conv2d(pictures, window.view(1, 1, 1, -1), padding=(0, half))
    return functional.conv2d(across, window.view(1, 1, -1, 1), padding=(half, 0))


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Returns the SSIM of two images [H, W, C] in [0, 1] for every pixel and channel, with zero padding.

    >>> picture = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> similarity = ssim_map(picture, picture)
    >>> similarity.shape, bool(torch.allclose(similarity, torch.ones_like(similarity)))
    (torch.Size([16, 16, 3]), True)
    """
    channels = image.shape[-1]
    x, y = (picture.permute(2, 0, 1)[:, None] for picture in (image, target))
    blurred = _blurred(torch.cat([x, y, x * x, y * y, x * y]))
    mean_x, mean_y, xx, yy, xy = torch.split(blurred, channels)
    variance_x, variance_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    denominator = (mean_x**2 + mean_y**2 + SSIM_C1) * (variance_x + variance_y + SSIM_C2)
    similarity: Tensor = (numerator / denominator)[:, 0].permute(1, 2, 0)
    return similarity


def image_loss(image: Tensor, target: Tensor) -> Tensor:
    """Returns 0.8·mean|I − Î| + 0.2·(1 − mean SSIM), averaged over pixels and channels.

    Args:
        image: [H, W, C] rendered image. A mask is an image with one channel.
        target: [H, W, C] target image, in [0, 1].

    >>> picture = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> abs(float(image_loss(picture, picture))) < 1e-12
    True
    """
    l1 = (image - target).abs().mean()
    return (1 - SSIM_SHARE) * l1 + SSIM_SHARE * (1 - ssim_map(image, target).mean())


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """Returns the peak signal-to-noise ratio of two images [H, W, C] in [0, 1], in dB.

    >>> truth = torch.zeros(8, 8, 3, dtype=torch.float64)
    >>> round(float(psnr(truth + 0.1, truth)), 6)
    20.0
    """
    squares = ((image - target) ** 2).sum().clamp_min(SMALLEST_SQUARE)
    return 10 * torch.log10(image.numel() / squares)


def _pairs(neighbours: Tensor, weights: Tensor, rows: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the rows [m] with their neighbours [m, k] and weights [m, k]. If ``rows`` is None, all rows are used."""
    if rows is None:
        return torch.arange(len(neighbours), device=neighbours.device), neighbours, weights
    return rows, neighbours[rows], weights[rows]


def rigidity_loss(
    means: Tensor, turns: Tensor, previous: Tensor, neighbours: Tensor, weights: Tensor, rows: Tensor | None = None
) -> Tensor:
    """Returns the mean over pairs of sqrt(w·|R_iᵀ(μ_j − μ_i) − (μ_j − μ_i)_previous|² + 1e-20), in metres.

    Args:
        means: [M, 3] means in this frame, in metres.
        turns: [M, 4] rotations since the previous frame, as unit quaternions.
        previous: [M, 3] means in the previous frame, in metres.
        neighbours: [M, k] int64 rows of the neighbours of each Gaussian.
        weights: [M, k] weights of the pairs.
        rows: [m] int64 rows i to average over, or None for all.

    >>> previous = torch.tensor([[0.0, 0, 0], [1, 0, 0]])
    >>> still = torch.tensor([[1.0, 0, 0, 0]] * 2)
    >>> neighbours, weights = torch.tensor([[1], [0]]), torch.ones(2, 1)
    >>> rigidity_loss(previous + 5, still, previous, neighbours, weights)  # both moved alike
    tensor(1.0000e-10)
    >>> rigidity_loss(2 * previous, still, previous, neighbours, weights)  # apart by 1 m
    tensor(1.)
    """
    i, j, w = _pairs(neighbours, weights, rows)
    now = means[j] - means[i][:, None]
    before = previous[j] - previous[i][:, None]
    back = now @ quaternion_matrices(turns[i])  # row vectors: vᵀ R is (Rᵀ v)ᵀ
    return torch.sqrt(w * ((back - before) ** 2).sum(-1) + ROOT_FLOOR).mean()


def isometry_loss(
    means: Tensor, distances: Tensor, neighbours: Tensor, weights: Tensor, rows: Tensor | None = None
) -> Tensor:
    """Returns the mean over pairs of sqrt(w·(|μ_j − μ_i| − d_0)² + 1e-20), in metres.

    Args:
        means: [M, 3] means in this frame, in metres.
        distances: [M, k] distances d_0 of the pairs when the graph was built, in metres.
        neighbours: [M, k] int64 rows of the neighbours of each Gaussian.
        weights: [M, k] weights of the pairs.
        rows: [m] int64 rows i to average over, or None for all.

    >>> neighbours, weights = torch.tensor([[1], [0]]), torch.ones(2, 1)
    >>> means = torch.tensor([[0.0, 0, 0], [0, 1.5, 0]])
    >>> isometry_loss(means, torch.ones(2, 1), neighbours, weights)  # 1 m apart at the start, 1.5 m now
    tensor(0.5000)
    """
    i, j, w = _pairs(neighbours, weights, rows)
    d0 = distances if rows is None else distances[rows]
    now = torch.sqrt(((means[j] - means[i][:, None]) ** 2).sum(-1) + ROOT_FLOOR)
    return torch.sqrt(w * (now - d0) ** 2 + ROOT_FLOOR).mean()


def rotation_loss(turns: Tensor, neighbours: Tensor, weights: Tensor, rows: Tensor | None = None) -> Tensor:
    """Returns the mean over pairs of sqrt(w·|q_j − q_i|² + 1e-20) for the rotations since the previous frame.

    Args:
        turns: [M, 4] rotations since the previous frame, as unit quaternions with w ≥ 0.
        neighbours: [M, k] int64 rows of the neighbours of each Gaussian.
        weights: [M, k] weights of the pairs.
        rows: [m] int64 rows i to average over, or None for all.

    >>> turns = torch.tensor([[1.0, 0, 0, 0], [0.6, 0.8, 0, 0]])
    >>> rotation_loss(turns, torch.tensor([[1], [0]]), torch.ones(2, 1))
    tensor(0.8944)
    """
    i, j, w = _pairs(neighbours, weights, rows)
    return torch.sqrt(w * ((turns[j] - turns[i][:, None]) ** 2).sum(-1) + ROOT_FLOOR).mean()


def axis_lengths(factors: Tensor) -> Tensor:
    """Returns the lengths [M, 3] of the transported axes (the columns of the factors [M, 3, 3]), in metres."""
    lengths: Tensor = torch.linalg.vector_norm(factors, dim=-2)
    return lengths


def scale_loss(factors: Tensor, first_lengths: Tensor, max_scale: float) -> Tensor:
    """Returns the scale loss of equation (8), in metres.

    It is the mean of max(0, |column a of F| − max(max_scale, |column a of F in frame 0|)) over Gaussians and axes a.
    Unlike in the paper, an axis that keeps its frame-0 length is never penalized.

    Args:
        factors: [M, 3, 3] covariance factors in this frame.
        first_lengths: [M, 3] axis lengths in frame 0 (see ``axis_lengths``), in metres.
        max_scale: axis length up to which the loss is always 0, in metres.

    >>> factors = 0.5 * torch.eye(3)[None]
    >>> scale_loss(factors, first_lengths=torch.full((1, 3), 0.1), max_scale=0.02)
    tensor(0.4000)
    """
    return (axis_lengths(factors) - first_lengths.clamp_min(max_scale)).clamp_min(0).mean()


def floor_loss(means: Tensor, plane: Sequence[float]) -> Tensor:
    """Returns the mean depth of ``means`` [M, 3] below a plane (a, b, c, d), i.e. where a·x + b·y + c·z + d > 0.

    All lengths are in metres.

    >>> floor_loss(torch.tensor([[0.0, 1.5, 0], [0, 0, 0]]), plane=(0, 1, 0, -1))  # y points down, the floor is at 1
    tensor(0.2500)
    """
    return (means @ means.new_tensor(plane[:3]) + plane[3]).clamp(min=0).mean()


def soft_colour_loss(colours: Tensor, previous: Tensor) -> Tensor:
    """Returns the mean absolute difference between the current and the previous colours, [N, 3] each.

    >>> soft_colour_loss(torch.full((4, 3), 0.5), torch.full((4, 3), 0.25))
    tensor(0.2500)
    """
    return (colours - previous).abs().mean()
