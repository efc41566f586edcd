"""First update of a scene, which runs in several view orders because there is no previous motion to start from.

Which local minimum the update reaches is a matter of chance. With a bad order, it ends 1 to 5 dB below other orders,
and later updates do not recover. The orders also differ in their learning rates, because steps that are too large for
one scene are too small for another. The errors in all training views decide which result is best. Errors in a few
small images are not sufficient (docs/method.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scas4d_core.frame_outcome import OTHER_ORDERS, Candidate
from scas4d_core.update.result import UpdateResult

FASTER = (1.0, 2.0, 2.0)
"""Factors on the layers' rates (``UpdateSettings.cold_start_rates``), one for each order that may be tried."""
AGREE = 0.04
"""Relative difference of errors below which two orders have reached the same minimum, and no third order is tried."""
ANOTHER_ORDER = 1_000_003
"""Increment of the update's seed for each additional order."""


class OrderResult(NamedTuple):
    """The result of an update in one view order.

    Attributes:
        result: result of the update.
        fault: problem with the resulting state, or None.
        fits: PSNR of that state for each camera that was not excluded, in dB.
    """

    result: UpdateResult
    fault: str | None
    fits: Mapping[str, float]


def best_order(run: Callable[[int, float], OrderResult], seed: int) -> tuple[OrderResult, int]:
    """Runs an update in two or three view orders, and returns the best result and the number of orders run.

    An update that needs no iterations is not repeated.

    Args:
        run: function that takes a seed and a factor on the layers' rates, and runs the update.
        seed: seed of the first order.
    """
    ends: list[OrderResult] = []
    while len(ends) < len(FASTER) and not _agree(errors_of(ends)):
        ends.append(run(seed + len(ends) * ANOTHER_ORDER, FASTER[len(ends)]))
        if not ends[0].result.trace.losses:
            return ends[0], 1
    best = ends[int(np.argmin(errors_of(ends)))]
    others = sum(sum(end.result.trace.seconds.values()) for end in ends if end is not best)
    trace = replace(best.result.trace, seconds={**best.result.trace.seconds, OTHER_ORDERS: others})
    return best._replace(result=replace(best.result, trace=trace)), len(ends)


def errors_of(ends: Sequence[OrderResult]) -> list[float]:
    """Returns the RMS error ([0, 1]) of each result, averaged over cameras that were not excluded in any order.

    The error is infinite if a state is implausible, or no better than the previous state.
    """
    names = set.intersection(*(set(end.fits) for end in ends)) if ends else set()
    return [_error(end, sorted(names)) for end in ends]


def _error(end: OrderResult, names: Sequence[str]) -> float:
    if end.fault is not None or end.result.trace.kept is Candidate.PREVIOUS or not names:
        return np.inf
    error = float(np.mean([10 ** (-end.fits[name] / 20) for name in names]))
    return error if np.isfinite(error) else np.inf


def _agree(errors: Sequence[float]) -> bool:
    """Returns whether at least two errors are finite and all are within ``AGREE`` of the smallest.

    >>> _agree([1.0]), _agree([1.0, 1.03]), _agree([1.05, 1.0]), _agree([np.inf, np.inf])
    (False, True, False, False)
    """
    return len(errors) > 1 and max(errors) <= (1 + AGREE) * min(errors) < np.inf
