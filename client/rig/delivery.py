"""Result of a push: the scene, the lost frames, and how late the frames were."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from client.wire import SceneStatus


@dataclass
class Lateness:
    """Seconds by which the sending fell behind the pace, and seconds waited, by reason.

    Attributes:
        late: by how much each frame was acknowledged after its moment, plus one period: 0 means before the next one.
        busy: waited for a full queue, and how often.
        outage: waited for a service that did not answer, and how often.
        began: when the clock of the rig started: with the first frame, or once frame 0 was finished.
        before: how many of `late` were acknowledged before the clock started.
    """

    late: list[float] = field(default_factory=list)
    busy: float = 0.0
    busy_count: int = 0
    outage: float = 0.0
    outage_count: int = 0
    began: float = field(default_factory=time.monotonic)
    before: int = 0
    ended: float | None = None

    def summary(self, fps: float | None) -> str:
        """One line for a person."""
        count = len(self.late)
        timed = count - self.before
        seconds = (self.ended or time.monotonic()) - self.began
        parts = [f"sent {count} frame{'' if count == 1 else 's'}"]
        if timed > 1 and seconds > 0:
            asked = f" of {fps:g}" if fps else ""
            which = ", those after frame 0" if self.before else ""
            parts[0] += f"{which} at {(timed - 1) / seconds:.2f}{asked} a second"
        if fps and timed:
            behind = [value for value in self.late[self.before :] if value > 0]
            worst = f", at most {max(behind):.2f} s" if behind else ""
            parts.append(f"{len(behind)} acknowledged after the next was due{worst}")
        if self.busy_count:
            parts.append(f"waited {self.busy:.1f} s for a full queue ({self.busy_count} times)")
        if self.outage_count:
            parts.append(f"waited {self.outage:.1f} s for the service ({self.outage_count} tries)")
        return "; ".join(parts)


@dataclass
class Delivery:
    """Result of a push.

    Attributes:
        scene: id.
        lateness: how far the sending fell behind.
        lost: indices that the rig lost, declared missing.
        status: of the scene after the last frame; None while it goes on.
    """

    scene: str
    lateness: Lateness = field(default_factory=Lateness)
    lost: list[int] = field(default_factory=list)
    status: SceneStatus | None = None
