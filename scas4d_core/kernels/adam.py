"""Adam step (Kingma and Ba 2015) for a parameter table, with a learning rate per column.

The reference implementation is ``torch.optim.Adam``. Gradients that are non-finite, or so large or
small that the moments would overflow or become subnormal, are clamped and counted; see
``guards.GRADIENT_CEILING`` and ``guards.MOMENT_FLOOR``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from scas4d_core.guards import ADAM_EPSILON, GRADIENT_CEILING, MOMENT_FLOOR
from scas4d_core.kernels import lanes
from scas4d_core.kernels.jit import ONE, ZERO, kernel, parallel_kernel

EPSILON = np.float32(ADAM_EPSILON)
SMALLEST = np.float32(MOMENT_FLOOR)
LARGEST = np.float32(GRADIENT_CEILING)

COUNTED_GUARDS = ("gradient_ceiling", "moment_floor")
"""Names of the guards that ``adam`` counts."""

EVERY_ROW = np.ones(1, np.float32)
"""Value of ``by_row`` if all rows have the same learning rates."""

ROWS = 512
"""Number of rows per task."""
SERIAL = 2048
"""Number of rows up to which one thread takes the whole step, because starting several would take longer."""


def adam(
    parameters: NDArray[np.float32],
    gradients: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    rates: NDArray[np.float32],
    by_row: NDArray[np.float32],
    beta1: Any,
    beta2: Any,
    step: int,
) -> NDArray[np.int64]:
    """Takes one Adam step.

    Args:
        parameters: [n, columns] parameters, updated in place.
        gradients: [n, columns] gradients, C-contiguous. Values that trigger a guard are overwritten.
        first, second: [n, columns] first and second moments, updated in place.
        rates: [columns] learning rates.
        by_row: [n] learning rate factor of each row, or ``EVERY_ROW``.
        beta1, beta2: decay rates, float32.
        step: number of this step, counted from 1.

    Returns:
        [2] number of gradient values that triggered each guard in ``COUNTED_GUARDS``.
    """
    guard_counts = np.zeros((-(-len(parameters) // ROWS), len(COUNTED_GUARDS)), np.int64)
    take_step = adam_rows if len(parameters) > SERIAL else adam_few_rows
    take_step(parameters, gradients, first, second, rates, by_row, beta1, beta2, step, guard_counts)
    total: NDArray[np.int64] = guard_counts.sum(axis=0)
    return total


@kernel
def guard_gradients(gradients, first, last, guard_counts):
    """Clamps gradients in the flat index range [first, last).

    The numbers of clamped values are added to ``guard_counts`` [2].
    """
    # The sum and the smallest nonzero size show whether any value must be clamped. NaN and infinity
    # propagate to the sum.
    total, least = lanes.fill(ZERO), lanes.fill(ONE)
    for place in range(first, last, lanes.COUNT):
        size = lanes.magnitude(lanes.load_first(gradients, place, last - place))
        total += size
        least = lanes.choose(size > ZERO, lanes.minimum(size, least), least)
    if lanes.sum_of(total) <= LARGEST and not lanes.any_of(least <= SMALLEST):
        return
    held = flushed = lanes.fill(ZERO)
    one, most = lanes.fill(ONE), lanes.fill(LARGEST)
    for place in range(first, last, lanes.COUNT):
        given = lanes.load_first(gradients, place, last - place)
        size = lanes.magnitude(given)
        tiny = (size > ZERO) & (size <= SMALLEST)
        fits = size <= LARGEST
        # NaN is neither greater nor less than 0, so it becomes 0.
        bound = lanes.choose(given > ZERO, most, lanes.choose(given < ZERO, -most, lanes.fill(ZERO)))
        taken = lanes.choose(fits, lanes.choose(tiny, lanes.fill(ZERO), given), bound)
        lanes.store_first(gradients, place, last - place, taken)
        held += lanes.choose(fits, lanes.fill(ZERO), one)
        flushed += lanes.choose(tiny, one, lanes.fill(ZERO))
    guard_counts[0] += np.int64(lanes.sum_of(held))
    guard_counts[1] += np.int64(lanes.sum_of(flushed))


@kernel
def adam_task(task, parameters, gradients, first, second, rates, by_row, beta1, beta2, step, guard_counts):
    """Takes the step for the rows of one task, sixteen rows at a time; see ``adam``."""
    rows, columns = parameters.shape
    begin, end = task * ROWS, min(rows, (task + 1) * ROWS)
    guard_gradients(gradients, begin * columns, end * columns, guard_counts[task])
    correction1 = ONE - np.float32(beta1**step)
    correction2 = ONE - np.float32(beta2**step)
    # Sixteen rows are a whole number of vectors, in which the rates repeat every ``columns`` values.
    rates_of_rows = np.empty(lanes.COUNT * columns, np.float32)
    for k in range(lanes.COUNT * columns):
        rates_of_rows[k] = by_row[0] * rates[k % columns]
    for i in range(begin, end, lanes.COUNT):
        some = min(end - i, lanes.COUNT)
        if by_row.shape[0] > 1:
            for row in range(some):
                for k in range(columns):
                    rates_of_rows[row * columns + k] = by_row[i + row] * rates[k]
        for k in range(0, some * columns, lanes.COUNT):
            place, left = i * columns + k, some * columns - k
            g = lanes.load_first(gradients, place, left)
            m = beta1 * lanes.load_first(first, place, left) + (ONE - beta1) * g
            v = beta2 * lanes.load_first(second, place, left) + (ONE - beta2) * g * g
            m = lanes.choose(lanes.magnitude(m) > SMALLEST, m, lanes.fill(ZERO))
            v = lanes.choose(v > SMALLEST * SMALLEST, v, lanes.fill(ZERO))
            lanes.store_first(first, place, left, m)
            lanes.store_first(second, place, left, v)
            change = lanes.load(rates_of_rows, k) * (m / correction1)
            change = change / (lanes.square_root(v / correction2) + EPSILON)
            lanes.store_first(parameters, place, left, lanes.load_first(parameters, place, left) - change)


@parallel_kernel
def adam_rows(parameters, gradients, first, second, rates, by_row, beta1, beta2, step, guard_counts):
    """Implements ``adam`` with parallel tasks, which add to ``guard_counts`` [tasks, 2]."""
    for task in prange(guard_counts.shape[0]):
        adam_task(np.int64(task), parameters, gradients, first, second, rates, by_row, beta1, beta2, step, guard_counts)


@kernel
def adam_few_rows(parameters, gradients, first, second, rates, by_row, beta1, beta2, step, guard_counts):
    """Same as ``adam_rows``, on one thread."""
    for task in range(guard_counts.shape[0]):
        adam_task(task, parameters, gradients, first, second, rates, by_row, beta1, beta2, step, guard_counts)
