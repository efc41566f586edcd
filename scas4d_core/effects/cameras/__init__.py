"""Effects on the cameras: their poses."""
