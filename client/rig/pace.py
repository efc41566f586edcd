"""Pace of the rig simulator: frame rate, jitter and losses."""

from __future__ import annotations

import random
from dataclasses import dataclass


@dataclass(frozen=True)
class Pace:
    """Frame rate, jitter and losses of a simulated rig; deterministic for a given seed.

    Attributes:
        fps: frames per second; None to send as fast as the service accepts frames.
        jitter: maximum delay of a frame in seconds, uniformly distributed; models cables, encoders and switches.
        drop: fraction of frames that the rig loses, in [0, 1]. Frame 0 is never lost.
        seed: random seed for the jitter and losses.

    >>> pace = Pace(fps=30, drop=0.5)
    >>> [pace.drops(index) for index in range(4)] == [pace.drops(index) for index in range(4)]
    True
    >>> pace.drops(0)
    False
    """

    fps: float | None = None
    jitter: float = 0.0
    drop: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.fps is not None and not self.fps > 0:
            raise ValueError(f"fps must be positive; got {self.fps!r}")
        if not self.jitter >= 0:
            raise ValueError(f"jitter must be at least 0 seconds; got {self.jitter!r}")
        if not 0 <= self.drop < 1:
            raise ValueError(f"drop must be a fraction in [0, 1); got {self.drop!r}")

    def drops(self, index: int, camera: str = "") -> bool:
        """Returns whether this frame, or one camera's image of it, is lost; deterministic."""
        return index > 0 and random.Random(f"{self.seed} {index} {camera} lost").random() < self.drop

    def delay(self, index: int, camera: str = "") -> float:
        """Returns the delay in seconds of this frame or of one camera's image; deterministic."""
        return random.Random(f"{self.seed} {index} {camera} late").uniform(0, self.jitter)
