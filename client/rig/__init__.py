"""The rig simulator: a capture on disk, sent as a rig would send it."""

from client.rig.delivery import Delivery, Lateness
from client.rig.pace import Pace
from client.rig.sequence import Sequence
from client.rig.simulator import OnProgress, push

__all__ = ["Delivery", "Lateness", "OnProgress", "Pace", "Sequence", "push"]
