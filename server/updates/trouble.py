"""Why a scene is degraded: a sentence about its last frame, its worker or the disk."""

from __future__ import annotations

from client.wire import FrameReportModel, FrameState
from server.hub import Publisher
from server.storage.ledger import Ledger


class Trouble:
    """Keeps the sentence that says why a scene is degraded.

    Attributes:
        sentence: None where the scene is not degraded. Who sets it publishes the change.
    """

    def __init__(self, publisher: Publisher, sentence: str | None) -> None:
        self._publisher = publisher
        self.sentence = sentence

    def report(self, sentence: str) -> None:
        """Sets the sentence and publishes the change."""
        self.sentence = sentence
        self._publisher.changed()


def trouble_of(report: FrameReportModel) -> str | None:
    """Says why a scene is degraded whose newest finished frame has this report; None: it is not."""
    if report.state == FrameState.FAILED:
        return f"frame {report.index} failed: {report.error}"
    if report.outcome is not None and report.outcome.degraded:
        verb = "" if report.outcome.rejected else "committed in part: "
        return f"frame {report.index} was {verb}{report.degraded}"
    if report.dropped_cameras:
        left_out = "; ".join(f"{name}: {reason}" for name, reason in report.dropped_cameras.items())
        return f"frame {report.index} was committed without camera {left_out}"
    return None


def last_trouble(ledger: Ledger) -> str | None:
    """Says what went wrong with the newest frame that was tried, or None."""
    last = ledger.last_tried()
    return None if last is None else trouble_of(ledger.frames[last].report)
