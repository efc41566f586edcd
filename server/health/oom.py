"""Number of processes killed by the kernel's out-of-memory killer."""

from __future__ import annotations

from pathlib import Path


def oom_kills() -> int:
    """Returns the number of processes in this control group that the out-of-memory killer has killed."""
    try:
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            number, _, path = line.partition("::")
            if number == "0":
                events = Path("/sys/fs/cgroup") / path.lstrip("/") / "memory.events"
                counts = dict(pair.split() for pair in events.read_text().splitlines())
                return int(counts.get("oom_kill", 0))
    except (OSError, ValueError):  # this system has no control groups
        pass
    return 0
