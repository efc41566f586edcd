"""Studies of exports, which are read back with third-party readers and rendered."""
