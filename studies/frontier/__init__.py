"""Studies of accuracy versus time."""
