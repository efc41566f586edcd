"""Studies of the service under load and faults."""
