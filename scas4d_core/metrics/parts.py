"""Metric that compares part labels with ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import adjusted_rand_score


def adjusted_rand_index(
    labels: NDArray[Any], truth: NDArray[Any], foreground: NDArray[np.bool_] | None = None
) -> float:
    """Returns the chance-corrected agreement between two partitions of the foreground (Hubert and Arabie 1985).

    Pixels from several frames and cameras can be stacked. They are then pooled, so each part must have the same label
    throughout. The label values themselves do not matter. Foreground pixels without a rendered part count as one part.

    Args:
        labels: [...] rendered integer labels.
        truth: [...] integer ground-truth labels, of the same shape.
        foreground: [...] bool mask of the pixels to compare. If None, all pixels with a non-zero true label are used.

    Returns:
        1 for identical partitions, and about 0 for random labels.

    Raises:
        ValueError: if the shapes differ, or if there are no foreground pixels.

    >>> truth = np.array([0, 1, 1, 2, 2])  # the first pixel is background
    >>> adjusted_rand_index(np.array([5, 7, 7, 4, 4]), truth)
    1.0
    """
    if labels.shape != truth.shape:
        raise ValueError(
            f"labels have shape {labels.shape}, but truth has shape {truth.shape}; render at the ground-truth size"
        )
    counted = truth != 0 if foreground is None else np.asarray(foreground) != 0
    if counted.shape != truth.shape:
        raise ValueError(f"foreground must have shape {truth.shape}, like the labels; got {counted.shape}")
    if not counted.any():
        raise ValueError("there are no foreground pixels to compare")
    return float(adjusted_rand_score(truth[counted].ravel(), labels[counted].ravel()))
