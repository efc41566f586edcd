"""Delays and sizes of the model, with their sources. A pair of seconds is the range of a uniform distribution."""

from __future__ import annotations

Range = tuple[float, float]

# Measured on three nodes, docs/cluster.md.

START_S: Range = (2.0, 4.0)
"""Delay from a worker's placement on a node to its `Ready`."""
NOTICED_S: Range = (3.0, 9.0)
"""Delay from a node's silence until Ray declares it lost, with checks every 1 s, a 2 s timeout and 3 failures."""
TOLD_S: Range = (3.0, 6.0)
"""Delay from Ray's declaration until the service is notified.

It is chosen so that a scene continues 14 to 18 s after the failure, as measured.
"""

HEAD_S: Range = (3.0, 5.5)
"""Time for which a killed head does not respond, measured by `scripts/bench head` with Redis and a supervisor."""

# From Ray.

PLACED_PER_S = 550.0
"""Number of actors that the head places per second, one after the other.

The source is `many_actors` of Ray's release tests, with 10,000 actors on 64 nodes.
"""
TOP_SHARE, SPREAD_ABOVE = 0.2, 0.5
"""Share of the nodes, emptiest first, from which Ray's scheduler draws, and load below which a node counts as empty."""
WAIT_S = 3.0
"""`WAIT_S` of server/cluster/ray_placement.py, which cannot be imported without Ray."""
MESSAGE_S: Range = (0.001, 0.02)
"""Latency of a message between the service and a worker. According to docs/cluster.md, it adds 3.9 ms to a view."""

# Assumed, not measured.

STOPPING_S: Range = (0.1, 1.0)
"""Time that a worker takes to stop on request."""
LATE_S: Range = (0.5, 10.0)
"""Time for which actors keep running after their service has ended."""
ADRIFT_S: Range = (1.0, 120.0)
"""Time for which an abandoned worker keeps running. A real worker ends within 0.5 s of its parent's end."""
ADRIFT_UPDATE_S: Range = (0.5, 5.0)
"""Seconds per update of an abandoned worker. Its updates are fast, so it writes many files that must not be read."""
PAUSE_S: Range = (1.0, 240.0)
"""Time for which a node is stopped or cut off, which may be too short for Ray to notice."""
REPLACED_S: Range = (30.0, 120.0)
"""Delay before a new node joins to replace one that was killed or came back too late."""
DOWN_S: Range = (1.0, 20.0)
"""Delay from the service's end to its next start."""
RECOVER_S = 5.0
"""Seconds within which the service recovers all its scenes after its start."""
JOURNAL_S: Range = (0.001, 0.01)
"""Time that the service takes to record a worker's death in the journal."""
QUICKEST_S, LONGEST_SHARE = 2.0, 0.6
"""Bounds of an update's duration, which is drawn log-uniformly.

The minimum is in seconds, and the maximum is a fraction of the time between frames.
"""
