"""Cost of the kernels, and of the start of the service."""
