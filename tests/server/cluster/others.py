"""Calls beside those that a test looks at: once they are over, calls that were free to begin have begun."""

from __future__ import annotations

from server.cluster.ray_calls import THREADS, RayCalls


async def others_have_called() -> None:
    """Returns once more calls than there are threads, begun now by somebody who holds none back, are over."""
    calls = RayCalls()
    try:
        for call in [calls.call(lambda: None) for _ in range(10 * THREADS)]:
            await call
    finally:
        calls.close()
