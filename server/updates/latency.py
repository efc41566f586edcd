"""Times at which a scene's newest frames passed each stage, from acknowledgement to publication."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from client.wire import FrameLatency
from server import counters

FRAMES_KEPT = 512
"""Number of newest frames whose times are kept in memory; a restart of the service forgets them."""


@dataclass
class FrameTimes:
    """Times of one frame in seconds of a monotonic clock; None until the frame reaches the stage."""

    received: float
    started: float | None = None
    solved: float | None = None
    committed: float | None = None
    published: float | None = None


class Latencies:
    """Recorder of one scene's frame times.

    Args:
        now: monotonic clock that returns seconds.

    Example:
        >>> seconds = iter([0.0, 1.0, 3.0, 3.5, 3.5])
        >>> latencies = Latencies(lambda: next(seconds))
        >>> latencies.receive(7)
        >>> latencies.start(7)
        >>> latencies.solve(7)
        >>> latencies.commit(7)
        >>> latencies.of(7)
        FrameLatency(queue=1.0, update=2.0, commit=0.5, total=3.5)
        >>> latencies.behind([7])
        3.5
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._frames: OrderedDict[int, FrameTimes] = OrderedDict()

    def receive(self, index: int) -> None:
        """Records that a frame was acknowledged."""
        self._frames[index] = FrameTimes(self._now())
        while len(self._frames) > FRAMES_KEPT:
            self._frames.popitem(last=False)

    def start(self, index: int) -> None:
        """Records that the worker received a frame; after a crash, the last start counts."""
        if (times := self._frames.get(index)) is not None:
            times.started, times.solved = self._now(), None

    def solve(self, index: int) -> None:
        """Records that the state of a frame is in the worker's memory."""
        if (times := self._frames.get(index)) is not None:
            times.solved = self._now()

    def commit(self, index: int) -> None:
        """Records that a frame is committed, and adds its latency to the metrics."""
        if (times := self._frames.get(index)) is not None:
            times.committed = self._now()
            if (latency := self.of(index)) is not None:
                for stage, seconds in latency:
                    counters.FRAME_LATENCY.labels(stage).observe(seconds)

    def publish(self, index: int) -> float | None:
        """Records that the state of a frame is being sent to a viewer; only the first viewer counts in the metrics.

        Returns:
            The seconds since the commit, or None if they are unknown.
        """
        times = self._frames.get(index)
        if times is None or times.committed is None:
            return None
        age = self._now() - times.committed
        if times.published is None:
            times.published = self._now()
            counters.FRAME_LATENCY.labels("publish").observe(age)
        return age

    def of(self, index: int) -> FrameLatency | None:
        """Returns the latency of a committed frame, or None if its times are unknown."""
        times = self._frames.get(index)
        if times is None or times.started is None or times.solved is None or times.committed is None:
            return None
        return FrameLatency(
            queue=times.started - times.received,
            update=times.solved - times.started,
            commit=times.committed - times.solved,
            total=times.committed - times.received,
        )

    def behind(self, unfinished: Iterable[int]) -> float:
        """Returns the seconds since the oldest of the given frames was received; 0 if there is none with a time."""
        known = [self._frames[index].received for index in unfinished if index in self._frames]
        return self._now() - min(known) if known else 0.0
