"""Delays and sizes of the model, with sources; a pair of seconds is the range of a uniform distribution."""

from __future__ import annotations

Range = tuple[float, float]

# Measured on three nodes, docs/cluster.md.

START_S: Range = (2.0, 4.0)
"""From a worker's place on a node to its `Ready`."""
NOTICED_S: Range = (3.0, 9.0)
"""From a node's silence until Ray takes it for lost, with checks every 1 s that may take 2 s and fail 3 times."""
TOLD_S: Range = (3.0, 6.0)
"""From then until the service is notified: the rest of the 14 to 18 s that pass in all until a scene goes on."""

HEAD_S: Range = (3.0, 5.5)
"""The head does not answer for so long after its end: `scripts/bench head`, with Redis and a supervisor."""

# Of Ray.

PLACED_PER_S = 550.0
"""Actors that the head places, one after the other: `many_actors` of Ray's own release tests, 10,000 on 64 nodes."""
TOP_SHARE, SPREAD_ABOVE = 0.2, 0.5
"""Ray's scheduler draws from the emptiest fifth of the nodes; nodes that are less than half full count as empty."""
WAIT_S = 3.0
"""`WAIT_S` of server/cluster/ray_placement.py, which cannot be imported without Ray."""
MESSAGE_S: Range = (0.001, 0.02)
"""A message between the service and a worker; docs/cluster.md: 2.9 ms more a view."""

# Assumed: nothing measured them.

STOPPING_S: Range = (0.1, 1.0)
"""A worker that is asked to stop."""
LATE_S: Range = (0.5, 10.0)
"""Actors of a service that has ended go on for so long."""
ADRIFT_S: Range = (1.0, 120.0)
"""A worker that was given up, and runs, goes on for so long: its parent's end ends a real one within 0.5 s."""
ADRIFT_UPDATE_S: Range = (0.5, 5.0)
"""Its updates: quick, so that much is written that must not be read."""
PAUSE_S: Range = (1.0, 240.0)
"""A node is stopped, or cut off, for so long; for less than Ray takes to notice, too."""
REPLACED_S: Range = (30.0, 120.0)
"""A new node parents so long after one was killed, or came back too late."""
DOWN_S: Range = (1.0, 20.0)
"""From the service's end to its next start."""
RECOVER_S = 5.0
"""The service finds all its scenes within so long after its start."""
JOURNAL_S: Range = (0.001, 0.01)
"""The service writes a worker's death to the journal."""
QUICKEST_S, LONGEST_SHARE = 2.0, 0.6
"""An update takes between these, the logarithm drawn evenly: seconds, and a share of the seconds between frames."""
