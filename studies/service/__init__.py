"""Studies of the service under load, faults and hostile requests."""
