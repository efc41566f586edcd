"""Studies of exports, read back with third-party readers and rendered."""
