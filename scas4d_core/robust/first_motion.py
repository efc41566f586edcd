"""The first update of a scene, in several orders of its views: no motion leads it, and it decides for all after it.

Which basin it ends in is chance: with a bad order it ends 1 to 5 dB below others, and later updates do not find what it
missed. Orders differ in their rates, too, for what one scene's steps pass over, another's do not reach. The errors of
the ends in all training views decide which is best; a few small pictures do not (docs/method.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from scas4d_core.frame_outcome import OTHER_ORDERS, Candidate
from scas4d_core.update.result import UpdateResult

FASTER = (1.0, 2.0, 2.0)
"""Factors on the rates of the layers (``UpdateSettings.cold_start_rates``), one for each order that may be tried."""
AGREE = 0.04
"""Two orders whose errors lie within this share of each other ended in the same basin: no third one is tried."""
ANOTHER_ORDER = 1_000_003
"""Added to the seed of an update for each order after the first."""


class OrderResult(NamedTuple):
    """The end of one order.

    Attributes:
        result, fault: of the update, and what is wrong with its state, or None.
        fits: dB by camera of that state; without those that the update left out.
    """

    result: UpdateResult
    fault: str | None
    fits: Mapping[str, float]


def best_order(run: Callable[[int, float], OrderResult], seed: int) -> tuple[OrderResult, int]:
    """Runs an update in two orders of its views, or three; returns the best end, and how many ran.

    An update that needed no iteration is not tried again.

    Args:
        run: the update, with a seed and a factor on the rates of the layers. seed: of the first order.
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
    """Root mean square error, 0…1, of each end: the mean over the cameras that all orders believed.

    Infinite where a state is not plausible, or no better than not moving.
    """
    names = set.intersection(*(set(end.fits) for end in ends)) if ends else set()
    return [_error(end, sorted(names)) for end in ends]


def _error(end: OrderResult, names: Sequence[str]) -> float:
    if end.fault is not None or end.result.trace.kept is Candidate.PREVIOUS or not names:
        return np.inf
    error = float(np.mean([10 ** (-end.fits[name] / 20) for name in names]))
    return error if np.isfinite(error) else np.inf


def _agree(errors: Sequence[float]) -> bool:
    """True where two errors or more are finite and lie within ``AGREE`` of the least.

    >>> _agree([1.0]), _agree([1.0, 1.03]), _agree([1.05, 1.0]), _agree([np.inf, np.inf])
    (False, True, False, False)
    """
    return len(errors) > 1 and max(errors) <= (1 + AGREE) * min(errors) < np.inf
