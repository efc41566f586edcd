"""Null engine: an engine whose iterations do nothing, so that a frame costs only what surrounds the update.

Θ_t is Θ_{t−1} moved by the predicted motion. Decoding, checks, presence, commits, durability and messages are the real
ones.
"""

from __future__ import annotations

from collections.abc import Sequence

from scas4d_core import preparation
from scas4d_core.engines.choose import Device
from scas4d_core.engines.cpu.engine import CpuEngine
from scas4d_core.engines.engine import REPORT, StepScalars, UpdateEngine, ViewRecord

PSNR_DB, LOSS = 30.0, 0.03


class NullEngine(CpuEngine):
    """CPU engine whose iterations neither render nor optimize, and whose probe views always give the same loss."""

    name = "null"

    def iterate(self, views: Sequence[int], step: StepScalars) -> None:
        """Logs a loss and a PSNR for each view."""
        self._log.losses.append(LOSS)
        self._log.rendered += [ViewRecord(view, PSNR_DB, (0.0, 0.0, 0.0)) for view in views]
        self._start.lap(REPORT)

    def probe(self, which: Sequence[int], *, moved: bool, learnt: bool) -> list[float]:
        """Returns the same loss for every probe view."""
        return [LOSS for _ in which]


def install() -> None:
    """Makes this process run all updates on the null engine."""

    def null_engine(device: Device) -> UpdateEngine:
        return NullEngine()

    setattr(preparation, "engine_of", null_engine)  # noqa: B010
