"""Studies of the cost of the kernels."""
