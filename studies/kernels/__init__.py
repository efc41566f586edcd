"""Studies of the cost of the kernels and of the service's start."""
