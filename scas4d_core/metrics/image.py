"""Metrics that compare images with ground truth: PSNR, SSIM, FLIP and LPIPS.

Images are [H, W, 3] arrays, either floats in [0, 1] or uint8 in 0…255. Floats are first clamped to [0, 1], as on a
display.
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2

LPIPS_WEIGHTS = "vgg16-397923af.pth"
"""File name of the torchvision weights that the lpips package loads from the torch.hub cache."""


@dataclass(frozen=True)
class Score:
    """Result of a metric that may be unavailable.

    Attributes:
        value: value of the metric, or None if it could not be computed.
        reason: why the value is missing and how to make it available; empty if there is a value.
    """

    value: float | None
    reason: str = ""


def psnr(image: NDArray[Any], truth: NDArray[Any], mask: NDArray[Any] | None = None) -> float:
    """Returns the peak signal-to-noise ratio in dB: −10 log10 of the mean squared error over pixels and channels.

    Args:
        image: [H, W, 3] rendered image.
        truth: [H, W, 3] ground-truth image.
        mask: [H, W] mask of the pixels to compare, for example the foreground. If None, all pixels are compared.

    Returns:
        PSNR in dB. It is infinite for equal images, and NaN for an empty mask.

    Raises:
        ValueError: if the shapes differ, or if an image has an invalid dtype or value.

    >>> truth = np.zeros((8, 8, 3))
    >>> round(psnr(truth + 0.1, truth), 6), psnr(truth, truth)
    (20.0, inf)
    """
    first, second = _pair(image, truth)
    squared = (first - second) ** 2
    if mask is not None:
        if mask.shape != first.shape[:2]:
            raise ValueError(f"mask must have shape {first.shape[:2]}, like the images; got {mask.shape}")
        squared = squared[np.asarray(mask) != 0]
    if squared.size == 0:
        return math.nan
    error = float(squared.mean())
    return math.inf if error == 0 else -10.0 * math.log10(error)


def ssim(image: NDArray[Any], truth: NDArray[Any]) -> float:
    """Returns the structural similarity (Wang et al. 2004), averaged over pixels and channels.

    As in 3D Gaussian Splatting, SSIM uses an 11×11 Gaussian window with σ = 1.5 px, zero padding, C1 = 0.01²,
    C2 = 0.03², biased variances and values in [0, 1].

    Args:
        image: [H, W, 3] rendered image.
        truth: [H, W, 3] ground-truth image.

    Returns:
        SSIM, which is 1 for equal images and lower for all others.

    Raises:
        ValueError: if the shapes differ, or if an image has an invalid dtype or value.

    >>> picture = np.random.default_rng(0).random((32, 32, 3))
    >>> ssim(picture, picture), round(ssim(1 - picture, picture), 2)
    (1.0, -0.73)
    """
    x, y = _pair(image, truth)
    mean_x, mean_y = _window_mean(x), _window_mean(y)
    variance_x = _window_mean(x * x) - mean_x**2
    variance_y = _window_mean(y * y) - mean_y**2
    covariance = _window_mean(x * y) - mean_x * mean_y
    similarity = ((2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)) / (
        (mean_x**2 + mean_y**2 + SSIM_C1) * (variance_x + variance_y + SSIM_C2)
    )
    return float(similarity.mean())


def flip(image: NDArray[Any], truth: NDArray[Any]) -> Score:
    """Returns the mean LDR-ꟻLIP error (Andersson et al. 2020) at the recommended 67 pixels per degree.

    Args:
        image: [H, W, 3] rendered image in sRGB.
        truth: [H, W, 3] ground-truth image in sRGB.

    Returns:
        The score, 0 for equal images. Its value is None if the flip_evaluator package is not installed.

    Raises:
        ValueError: if the shapes differ, or if an image has an invalid dtype or value.

    >>> picture = np.full((16, 16, 3), 0.5)
    >>> flip(picture, picture)
    Score(value=0.0, reason='')
    """
    first, second = _pair(image, truth)
    try:
        evaluator = importlib.import_module("flip_evaluator")
    except ImportError:
        return Score(None, "flip_evaluator is not installed; run pip install flip-evaluator")
    _, error, _ = evaluator.evaluate(
        np.ascontiguousarray(second, dtype=np.float32),
        np.ascontiguousarray(first, dtype=np.float32),
        "LDR",
        inputsRGB=True,
        applyMagma=False,
        computeMeanError=True,
    )
    return Score(float(error))


def lpips(image: NDArray[Any], truth: NDArray[Any]) -> Score:
    """Returns the learned perceptual distance LPIPS (Zhang et al. 2018) with VGG, as for 3D Gaussian Splatting.

    No weights are downloaded.

    Args:
        image: [H, W, 3] rendered image.
        truth: [H, W, 3] ground-truth image.

    Returns:
        The score, 0 for equal images. Its value is None if a required package or the weights are not installed.

    Raises:
        ValueError: if the shapes differ, or if an image has an invalid dtype or value.

    >>> picture = np.full((64, 64, 3), 0.5)
    >>> score = lpips(picture, picture)
    >>> score.value == 0 or score.reason != ""  # the weights of the network may be missing
    True
    """
    first, second = _pair(image, truth)
    try:
        torch = importlib.import_module("torch")
        importlib.import_module("torchvision")
        importlib.import_module("lpips")
    except ImportError as fault:
        return Score(None, f"{fault.name} is not installed; run pip install lpips")
    weights = Path(torch.hub.get_dir()) / "checkpoints" / LPIPS_WEIGHTS
    if not weights.is_file():
        return Score(None, f"weights file {weights} not found; copy it there (it is never downloaded)")
    network = _lpips_network()
    with torch.no_grad():
        tensors = [torch.from_numpy(p.astype(np.float32)).permute(2, 0, 1)[None] * 2 - 1 for p in (first, second)]
        return Score(float(network(*tensors)))


@cache
def _lpips_network() -> Any:
    return importlib.import_module("lpips").LPIPS(net="vgg", verbose=False).eval()


def _window_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    window /= window.sum()
    rows = correlate1d(values, window, axis=0, mode="constant")
    mean: NDArray[np.float64] = correlate1d(rows, window, axis=1, mode="constant")
    return mean


def _pair(image: NDArray[Any], truth: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    if image.shape != truth.shape:
        raise ValueError(
            f"image has shape {image.shape}, but truth has shape {truth.shape}; render at the ground-truth size"
        )
    return _unit(image, "image"), _unit(truth, "truth")


def _unit(picture: NDArray[Any], name: str) -> NDArray[np.float64]:
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise ValueError(f"{name} must have shape [H, W, 3]; got {picture.shape}")
    if picture.dtype == np.uint8:
        return picture / 255.0
    if picture.dtype.kind != "f":
        raise ValueError(f"{name} must be uint8, or floats in [0, 1]; got dtype {picture.dtype}")
    if not np.isfinite(picture).all():
        raise ValueError(f"{name} contains NaN or infinity")
    unit: NDArray[np.float64] = np.clip(picture.astype(np.float64), 0.0, 1.0)
    return unit
