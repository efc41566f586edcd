"""Effects on cameras: their poses."""
