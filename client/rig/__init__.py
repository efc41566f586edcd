"""Rig simulator, which sends a capture from disk to the service like a live camera rig."""

from client.rig.delivery import Delivery, Lateness
from client.rig.pace import Pace
from client.rig.sequence import Sequence
from client.rig.simulator import OnProgress, push

__all__ = ["Delivery", "Lateness", "OnProgress", "Pace", "Sequence", "push"]
