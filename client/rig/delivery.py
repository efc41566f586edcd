"""Result of a push: the scene, the lost frames and the delays."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from client.left_out import LeftOut
from client.wire import SceneStatus


@dataclass
class Lateness:
    """Sending delays relative to the pace, and waiting times by reason, all in seconds.

    Attributes:
        late: delay of each frame's acknowledgement relative to the due time of the next frame; negative if early.
        busy: time spent waiting for space in the queue.
        busy_count: number of waits for space in the queue.
        outage: time spent waiting for a service that did not respond.
        outage_count: number of retries during outages.
        began: `time.monotonic()` when the rig's clock started: at the first frame, or when frame 0 was finished.
        before: number of entries in `late` for frames acknowledged before the clock started.
        ended: `time.monotonic()` after the last frame; None while sending.
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
        """Returns a one-line summary for users."""
        count = len(self.late)
        timed = count - self.before
        seconds = (self.ended or time.monotonic()) - self.began
        parts = [f"sent {count} frame{'' if count == 1 else 's'}"]
        if timed > 1 and seconds > 0:
            asked = f" of {fps:g}" if fps else ""
            which = ", those after frame 0" if self.before else ""
            parts[0] += f"{which} at {(timed - 1) / seconds:.2f}{asked} per second"
        if fps and timed:
            behind = [value for value in self.late[self.before :] if value > 0]
            worst = f", by at most {max(behind):.2f} s" if behind else ""
            parts.append(f"{len(behind)} acknowledged after the next frame was due{worst}")
        if self.busy_count:
            parts.append(f"waited {self.busy:.1f} s for space in the queue ({self.busy_count} times)")
        if self.outage_count:
            parts.append(f"waited {self.outage:.1f} s for the service ({self.outage_count} retries)")
        return "; ".join(parts)


@dataclass
class Delivery:
    """Result of a push.

    Attributes:
        scene: scene id.
        lateness: sending delays and waiting times.
        lost: indices of frames that the rig lost, or that have too few usable images, and that were declared missing.
        left_out: record of the images that cannot be used.
        status: scene status after the last frame; None while the push is running.
    """

    scene: str
    left_out: LeftOut
    lateness: Lateness = field(default_factory=Lateness)
    lost: list[int] = field(default_factory=list)
    status: SceneStatus | None = None
