"""Effects that correct camera poses."""
