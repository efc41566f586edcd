"""The rig simulator: sends a capture on disk as a rig would."""

from client.rig.delivery import Delivery, Lateness
from client.rig.pace import Pace
from client.rig.sequence import Sequence
from client.rig.simulator import OnProgress, push

__all__ = ["Delivery", "Lateness", "OnProgress", "Pace", "Sequence", "push"]
