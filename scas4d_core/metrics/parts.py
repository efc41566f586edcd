"""Comparison of part labels with ground truth."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import adjusted_rand_score


def adjusted_rand_index(
    labels: NDArray[Any], truth: NDArray[Any], foreground: NDArray[np.bool_] | None = None
) -> float:
    """Returns the agreement of two partitions of the foreground pixels, corrected for chance (Hubert and Arabie 1985).

    Stacked pixels of several frames and cameras are pooled, so a part must have the same label in all of them; the
    label numbers do not matter. A foreground pixel without a rendered part counts with its value in ``labels``, as one
    more part.

    Args:
        labels: [...] integers, rendered.
        truth: [...] integers of the same shape.
        foreground: [...] bool, pixels that count; None for those with non-zero truth.

    Returns:
        1 for the same partition, about 0 for random labels.

    Raises:
        ValueError: the shapes differ, or no pixel is foreground.

    >>> truth = np.array([0, 1, 1, 2, 2])  # the first pixel is background
    >>> adjusted_rand_index(np.array([5, 7, 7, 4, 4]), truth)
    1.0
    """
    if labels.shape != truth.shape:
        raise ValueError(f"labels have shape {labels.shape}, the truth {truth.shape}; render at the size of the truth")
    counted = truth != 0 if foreground is None else np.asarray(foreground) != 0
    if counted.shape != truth.shape:
        raise ValueError(f"foreground has shape {counted.shape}; give {truth.shape} like the labels")
    if not counted.any():
        raise ValueError("no pixel is foreground: nothing to compare")
    return float(adjusted_rand_score(truth[counted].ravel(), labels[counted].ravel()))
