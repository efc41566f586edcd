"""Batches of frames that are being sent, shared by the HTTP clients and the ingest WebSocket."""

from __future__ import annotations

from collections.abc import Sequence

from client.calls import NewFrame
from client.retries import OUTAGE_STATUSES
from client.wire import IngestAnswer

RETRIED_STATUSES = (429, *OUTAGE_STATUSES)
"""Status codes of frames that are sent again."""


class SendingBatch:
    """Frames of a batch that are not answered yet, and the answers to the others.

    Args:
        frames: the frames, in order.

    Attributes:
        left: frames that must be sent (again).
        answers: final answers to the frames before them.
    """

    def __init__(self, frames: Sequence[NewFrame]) -> None:
        self.left = list(frames)
        self.answers: list[IngestAnswer] = []

    def record(self, answers: Sequence[IngestAnswer]) -> float:
        """Records the answers to `left` and returns the seconds to wait before the remaining frames are sent again."""
        for answer in answers:
            if answer.status in RETRIED_STATUSES:
                return float(answer.retry_after or 1)
            self.answers.append(answer)
            del self.left[0]
        return 0.0
