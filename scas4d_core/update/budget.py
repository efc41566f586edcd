"""A frame's budget in milliseconds: when its last iteration has to be over, from what the frames before took.

Decoding comes before the iterations and is seen by the clock; comparing and checking the end, writing the checkpoint
and the commit come after them and are foreseen.
"""

from __future__ import annotations

from dataclasses import dataclass

from scas4d_core.update.result import Updated

RATE = 0.3
"""How fast what is foreseen follows what was."""
AFTER_S = 0.05
"""Seconds after the last iteration that are foreseen before any frame was measured."""


@dataclass
class Budget:
    """Of a scene.

    Attributes:
        milliseconds: a frame may take, None: as many as it needs. each: seconds of an iteration, None: not known yet.
        after: seconds from the last iteration to the end of the commit.
    """

    milliseconds: float | None
    each: float | None = None
    after: float = AFTER_S

    def end(self, began: float) -> float | None:
        """The moment by which the last iteration has to be over, of a frame begun at ``began``; None: no limit."""
        return None if self.milliseconds is None else began + self.milliseconds / 1000 - self.after

    def learn(self, updated: Updated, commit: float) -> None:
        """How long a frame took. ``commit``: seconds that checking and writing took."""
        if not updated.moments:
            return
        before = updated.seconds.get("start", 0.0)
        each = max(0.0, updated.moments[-1] - before) / len(updated.moments)
        after = commit + sum(updated.seconds.get(stage, 0.0) for stage in ("end", "commit"))
        if self.each is None:
            self.each, self.after = each, after
        else:
            self.each = min(each, self.each + RATE * (each - self.each))  # one slow frame is forgotten with the next
            self.after += RATE * (after - self.after)
