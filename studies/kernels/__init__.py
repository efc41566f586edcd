"""Costs of the kernels, and of a start."""
