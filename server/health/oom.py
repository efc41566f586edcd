"""Counts processes that the kernel has killed for want of memory."""

from __future__ import annotations

from pathlib import Path


def oom_kills() -> int:
    """Returns how many processes of this control group the kernel has killed for want of memory."""
    try:
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            number, _, path = line.partition("::")
            if number == "0":
                events = Path("/sys/fs/cgroup") / path.lstrip("/") / "memory.events"
                counts = dict(pair.split() for pair in events.read_text().splitlines())
                return int(counts.get("oom_kill", 0))
    except (OSError, ValueError):  # no control groups here
        pass
    return 0
