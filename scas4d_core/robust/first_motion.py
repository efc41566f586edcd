"""The first update of a scene, in several orders of its views: no motion leads it, and it decides for all after it.

Which basin it ends in is chance: with a bad order it ends 1 to 2 dB below others, and later updates do not find what it
missed. The error on the probe views does not tell; the loss of the last iterations does (docs/method.md, "Seeds").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from scas4d_core.update.result import UpdateResult, UpdateTrace

MOST = 3
"""Orders that are tried at most."""
AGREE = 0.02
"""Two orders that end with losses within this share of each other ended in the same basin: no third one is tried."""
ANOTHER_ORDER = 1_000_003
"""Added to the seed of an update for each order after the first."""
ROUNDS = 2
"""Over so many views of each camera, the last ones, the loss is compared."""
STAGE = "other orders"
"""The stage of what the orders take that are not kept."""


def best_order(run: Callable[[int], UpdateResult], seed: int, views: int) -> tuple[UpdateResult, int]:
    """Runs an update in two orders of its views, or three; returns the end with the least loss, and how many ran.

    Args:
        run: the update with a seed. seed: of the first order. views: that there are.
    """
    results = [run(seed)]
    if not results[0].trace.losses:  # nothing moved
        return results[0], 1
    while len(results) < MOST and not _agree([_last(result.trace, views) for result in results]):
        results.append(run(seed + len(results) * ANOTHER_ORDER))
    best = min(results, key=lambda result: _last(result.trace, views))
    others = sum(sum(result.trace.seconds.values()) for result in results if result is not best)
    return replace(best, trace=replace(best.trace, seconds={**best.trace.seconds, STAGE: others})), len(results)


def _last(trace: UpdateTrace, views: int) -> float:
    """Mean loss of the last rounds; infinite where it is not finite."""
    mean = float(np.mean(trace.losses[-ROUNDS * views :]))
    return mean if np.isfinite(mean) else np.inf


def _agree(losses: list[float]) -> bool:
    """True where two losses or more lie within ``AGREE`` of the least.

    >>> _agree([1.0]), _agree([1.0, 1.05]), _agree([1.05, 1.04])
    (False, False, True)
    """
    return len(losses) > 1 and max(losses) <= (1 + AGREE) * min(losses)
