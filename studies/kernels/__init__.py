"""Studies of the cost of the kernels and of starting the service."""
