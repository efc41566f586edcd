"""Effects on camera poses."""
