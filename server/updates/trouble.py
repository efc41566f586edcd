"""Reason why a scene is degraded. The message concerns the newest frame, the worker or the disk."""

from __future__ import annotations

from dataclasses import dataclass

from client.wire import FrameReportModel, FrameState
from server.hub import Publisher
from server.storage.ledger import Ledger


@dataclass(frozen=True)
class Reason:
    """Message on why a scene is degraded, and whether its newest frame lost cameras and nothing else is wrong."""

    sentence: str
    lost_cameras: bool = False


class Trouble:
    """Reason why a scene is degraded.

    Attributes:
        reason: the reason, or None if the scene is not degraded. Code that sets it must publish the change.
    """

    def __init__(self, publisher: Publisher, reason: Reason | None) -> None:
        self._publisher = publisher
        self.reason = reason

    def report(self, sentence: str) -> None:
        """Sets the message and publishes the status change."""
        self.reason = Reason(sentence)
        self._publisher.publish_status()


def trouble_in_report(report: FrameReportModel) -> Reason | None:
    """Returns why a scene is degraded according to its newest frame's report, or None if it is not degraded."""
    if report.state == FrameState.FAILED:
        return Reason(f"frame {report.index} failed: {report.error}")
    if report.outcome is not None and report.outcome.degraded:
        verb = "rejected; " if report.outcome.rejected else "partly committed: "
        return Reason(f"frame {report.index} was {verb}{report.degraded}")
    if report.dropped_cameras:
        left_out = "; ".join(f"{name}: {reason}" for name, reason in report.dropped_cameras.items())
        return Reason(f"frame {report.index} was committed without camera {left_out}", lost_cameras=True)
    return None


def last_trouble(ledger: Ledger) -> Reason | None:
    """Returns why a scene is degraded according to its newest committed or failed frame, or None."""
    last = ledger.last_tried()
    return None if last is None else trouble_in_report(ledger.frames[last].report)
